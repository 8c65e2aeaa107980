"""Whether a process should pause or stop, and what it waits for."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Final

LOG = logging.getLogger(__name__)

LOG_WAIT_AFTER_S: Final = 5.0
"""A wait is logged when it has lasted so long."""
LOG_WAIT_AGAIN_S: Final = 600.0


class Lifecycle:
    """Holds what signals and control messages ask of this process, and what it waits for.

    Used by several threads.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Start without any request.

        Args:
            clock: gives the time in seconds.
        """
        self._stop = threading.Event()
        self._paused = threading.Event()
        self._clock = clock
        self._lock = threading.Lock()
        self._waiting_for = ""
        self._waiting_since_s = 0.0
        self._log_at_s = 0.0
        self._log_again_s = LOG_WAIT_AGAIN_S
        self._logged = False
        self._worked_at_s = clock()

    @property
    def stopping(self) -> bool:
        """Whether this process was asked to stop."""
        return self._stop.is_set()

    @property
    def paused(self) -> bool:
        """Whether this process was asked to pause, and not to resume since."""
        return self._paused.is_set()

    @property
    def waiting_for(self) -> str:
        """What this process waits for; empty while it works."""
        return self._waiting_for

    @property
    def idle_s(self) -> float:
        """Time since the main loop of this process was last seen to go on (s)."""
        return self._clock() - self._worked_at_s

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
        self.goes_on()
        self._stop.wait(seconds)

    def goes_on(self) -> None:
        """Note that the main loop goes on. A process that stops doing so is killed in the end."""
        self._worked_at_s = self._clock()

    def waits_for(self, what: str, *, log_again_s: float = LOG_WAIT_AGAIN_S) -> None:
        """Say what this process waits for now, or with an empty text that it works.

        A wait that lasts is logged when it has lasted for LOG_WAIT_AFTER_S, and then again and
        again. The text may change during a wait, such as a number in it.

        Args:
            what: what it waits for.
            log_again_s: time between two lines about the wait (s); rarely, unless somebody has to
                do something.
        """
        self.goes_on()
        what = "".join(mark if mark.isprintable() else " " for mark in what)
        with self._lock:
            now_s = self._clock()
            before, self._waiting_for = self._waiting_for, what
            self._log_again_s = log_again_s
            if what and not before:
                self._waiting_since_s = now_s
                self._log_at_s = now_s + LOG_WAIT_AFTER_S
                self._logged = False
            over = not what and self._logged
            self._logged = self._logged and bool(what)
            waited_s = now_s - self._waiting_since_s
        if over:
            LOG.info("goes on after waiting %.0f s for %s", waited_s, before)
        self.log_wait()

    def log_wait(self) -> None:
        """Log what this process waits for, if it is due; called again and again."""
        with self._lock:
            now_s = self._clock()
            if not self._waiting_for or now_s < self._log_at_s:
                return
            self._log_at_s = now_s + self._log_again_s
            self._logged = True
            what, waited_s = self._waiting_for, now_s - self._waiting_since_s
        LOG.info("waiting for %s (since %.0f s)", what, waited_s)

    def stop_on_signals(self) -> None:
        """Treat SIGTERM and SIGINT as a request to stop."""

        def on_signal(_number: int, _frame: FrameType | None) -> None:
            self.stop()

        signal.signal(signal.SIGTERM, on_signal)
        signal.signal(signal.SIGINT, on_signal)
