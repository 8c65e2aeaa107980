"""Files with which other engines run the processes of a run: one module for each engine."""
