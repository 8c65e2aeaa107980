"""A signal asks a process to stop."""

from __future__ import annotations

import logging
import os
import signal

import pytest

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


def test_a_wait_is_logged_when_it_lasts_and_when_it_is_over(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    clock = [0.0]
    lifecycle = Lifecycle(clock=lambda: clock[0])
    for second in range(5):
        clock[0] = second
        lifecycle.waits_for(f"sequences ({second} of 9)")
    assert lifecycle.waiting_for == "sequences (4 of 9)"
    lifecycle.waits_for("")
    assert caplog.messages == [], "a short wait is not worth a line"
    for second in range(10, 20):
        clock[0] = second
        lifecycle.waits_for("the\nhub")
    lifecycle.waits_for("")
    assert lifecycle.waiting_for == ""
    assert caplog.messages == [
        "waiting for the hub (since 5 s)",
        "goes on after waiting 9 s for the hub",
    ]


def test_a_wait_that_needs_somebody_is_logged_again_and_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    clock = [0.0]
    lifecycle = Lifecycle(clock=lambda: clock[0])
    for second in range(70):
        clock[0] = second
        lifecycle.waits_for("a learner", log_again_s=30.0)
    assert caplog.messages == [
        f"waiting for a learner (since {second} s)" for second in (5, 35, 65)
    ]


def test_a_main_loop_that_does_not_go_on_is_seen() -> None:
    now_s = 0.0
    lifecycle = Lifecycle(clock=lambda: now_s)
    now_s = 700.0
    assert lifecycle.idle_s == 700.0
    lifecycle.goes_on()
    assert lifecycle.idle_s == 0.0
