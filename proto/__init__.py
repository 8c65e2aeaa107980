"""What crosses a process boundary: configuration, messages, keys, files and the bus."""

DISTRIBUTION = "vmdnn"  # vmdnn.py checks it, because other packages may be called `proto` too
