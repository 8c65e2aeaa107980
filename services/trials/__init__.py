"""Trials: played, counted, and compared between networks."""
