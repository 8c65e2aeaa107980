"""The tasks of the paper: their situations, scenes and readings of success."""
