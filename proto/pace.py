"""Measuring how often something happens per second."""

from __future__ import annotations

import threading
import time


class Pace:
    """Counts events in one thread, and gives their rate to another."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._count = 0
        self._since_s = time.monotonic()

    def add(self, count: int = 1) -> None:
        """Count events."""
        with self._lock:
            self._count += count

    def per_second(self) -> float:
        """Events per second since the last call."""
        with self._lock:
            now = time.monotonic()
            pace = self._count / max(now - self._since_s, 1e-6)
            self._count, self._since_s = 0, now
            return pace
