"""One module for each figure: `SUMMARY`, `configure(parser)` and `draw(arguments)`."""
