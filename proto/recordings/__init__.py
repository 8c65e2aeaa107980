"""Episodes as MCAP files: writing, reading and recovery."""
