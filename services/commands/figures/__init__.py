"""One module for each figure: `SUMMARY`, `configure(parser)` and `run(arguments)`."""
