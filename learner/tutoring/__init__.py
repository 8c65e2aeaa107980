"""Tutored sequences: kept on disk, selected for training, and still to be recorded."""
