"""What a worker process does about the process that started it."""

from __future__ import annotations

import multiprocessing
import os


def end_with_parent() -> None:
    """End this process when the one that started it ends; runs in a thread of its own."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
