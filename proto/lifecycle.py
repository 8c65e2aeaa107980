"""Whether a process should pause or stop."""

from __future__ import annotations

import signal
import threading
from types import FrameType


class Lifecycle:
    """Holds what signals and control messages ask of this process; used by several threads."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._paused = threading.Event()

    @property
    def stopping(self) -> bool:
        """Whether this process was asked to stop."""
        return self._stop.is_set()

    @property
    def paused(self) -> bool:
        """Whether this process was asked to pause, and not to resume since."""
        return self._paused.is_set()

    def stop(self) -> None:
        """Ask this process to stop."""
        self._stop.set()

    def pause(self) -> None:
        """Ask this process to pause."""
        self._paused.set()

    def resume(self) -> None:
        """End the pause."""
        self._paused.clear()

    def wait(self, seconds: float) -> None:
        """Wait for so many seconds; return earlier when this process is asked to stop."""
        self._stop.wait(seconds)

    def stop_on_signals(self) -> None:
        """Treat SIGTERM and SIGINT as a request to stop."""

        def on_signal(_number: int, _frame: FrameType | None) -> None:
            self.stop()

        signal.signal(signal.SIGTERM, on_signal)
        signal.signal(signal.SIGINT, on_signal)
