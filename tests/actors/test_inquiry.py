"""A question that nobody answers does not hold up the actor."""

from __future__ import annotations

import threading
import time

from processes import eventually

from actors.inquiry import PATIENCE_S, Inquiry


def test_a_frozen_process_delays_once_and_its_late_answer_is_used() -> None:
    wakes = threading.Event()

    def ask(question: str) -> list[str]:
        wakes.wait(60)
        return [f"answer to {question}"]

    inquiry = Inquiry(ask)
    assert inquiry.answers("a") == []
    assert inquiry.unanswered
    started_s = time.monotonic()
    assert [inquiry.answers("a") for _ in range(100)] == [[]] * 100
    assert time.monotonic() - started_s < PATIENCE_S, "it does not wait again"
    wakes.set()
    found: list[str] = []
    eventually(lambda: bool(found.extend(inquiry.answers("a")) or found), "the late answer")
    assert found == ["answer to a"]
    eventually(lambda: inquiry.answers("a") == ["answer to a"], "another answer")
    assert not inquiry.unanswered
    inquiry.close()


def test_the_answer_to_another_question_is_dropped() -> None:
    wakes = threading.Event()

    def ask(question: str) -> list[str]:
        wakes.wait(60)
        return [question]

    inquiry = Inquiry(ask)
    assert inquiry.answers("of policy 1") == []
    wakes.set()
    given: list[str] = []
    eventually(lambda: bool(given.extend(inquiry.answers("of policy 2")) or given), "an answer")
    assert given == ["of policy 2"]
    inquiry.close()
