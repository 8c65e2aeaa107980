"""What crosses a process boundary: configuration, messages, keys, files and the bus."""

DISTRIBUTION = "vmdnn"  # vmdnn.py sees by it whether another package took this name
