"""Clips of a person who points at one of two places: drawn from seeds, or read from videos."""
