"""Figures of the paper and of a policy's failures: their numbers, tables and drawings."""
