"""What crosses a process boundary: configuration, messages, keys, files and the bus."""
