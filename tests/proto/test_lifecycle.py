"""A signal asks a process to stop."""

from __future__ import annotations

import os
import signal

from proto.lifecycle import Lifecycle


def test_signals_ask_to_stop() -> None:
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    try:
        for number in (signal.SIGTERM, signal.SIGINT):
            lifecycle = Lifecycle()
            lifecycle.stop_on_signals()
            assert not lifecycle.stopping
            os.kill(os.getpid(), number)
            lifecycle.wait(10.0)
            assert lifecycle.stopping
    finally:
        signal.signal(signal.SIGTERM, before[0])
        signal.signal(signal.SIGINT, before[1])
