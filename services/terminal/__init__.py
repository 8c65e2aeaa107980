"""What people read in a terminal: the view of a run, progress bars, tables."""
