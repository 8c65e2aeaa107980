"""A repeated action continues after failures and ends with its context."""

from __future__ import annotations

import threading

from processes import PATIENCE_S

from proto.periodic import every


def test_a_repeated_action_continues_after_a_failure_and_ends_with_the_context() -> None:
    calls = 0
    third = threading.Event()

    def fail() -> None:
        nonlocal calls
        calls += 1
        if calls == 3:
            third.set()
        raise RuntimeError("on purpose")

    threads = threading.active_count()
    with every(0.01, fail):
        assert third.wait(PATIENCE_S)
    assert threading.active_count() == threads, "its thread has ended"
