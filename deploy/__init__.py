"""Starts the system: set-up, supervision, configurations. No other package imports this one."""

DISTRIBUTION = "vmdnn"  # vmdnn.py checks that no other distribution has replaced this package
