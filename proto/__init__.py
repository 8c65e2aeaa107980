"""What crosses a process boundary: configuration, messages, keys, files and the bus."""

DISTRIBUTION = "vmdnn"  # vmdnn.py checks that no other distribution has replaced this package
