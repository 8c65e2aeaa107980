"""Simulator backends, one folder each; nothing outside a folder imports its simulator."""
