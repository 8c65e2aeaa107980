"""Episodes as MCAP files: written, read, and recovered."""
