"""What people read in a terminal: the state of a run, progress bars, tables."""
