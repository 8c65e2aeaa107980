"""One module for each subcommand of `vmdnn`: `configure(parser)` and `run(arguments)`."""
