"""The paper's tasks, one folder each, and the registry that makes them by name."""
