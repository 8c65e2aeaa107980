"""Episodes in data formats of others: a module for each format."""
