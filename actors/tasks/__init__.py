"""The tasks of the paper, one folder each, and the registry that finds them by name."""
