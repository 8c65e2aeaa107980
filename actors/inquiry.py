"""Questions to another process that do not hold up the actor when nobody answers."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, Generic, TypeVar

PATIENCE_S: Final = 1.0
"""How long to wait for an answer, as long as answers come."""

Question = TypeVar("Question")
Answer = TypeVar("Answer")


class Inquiry(Generic[Question, Answer]):
    """Asks questions of one kind, one at a time.

    A process that is frozen is there, but does not answer: a question to it takes until its time is
    up. After the first such question the actor goes on while it waits for an answer.
    """

    def __init__(self, ask: Callable[[Question], list[Answer]]) -> None:
        """Ask with a function that gives the answers, and none if nobody answers in time."""
        self._ask = ask
        self._pool = ThreadPoolExecutor(max_workers=1)
        self._pending: tuple[Question, Future[tuple[list[Answer], float]]] | None = None
        self._patience_s = PATIENCE_S

    @property
    def unanswered(self) -> bool:
        """Whether the last question was not answered in time."""
        return self._patience_s == 0.0

    def answers(self, question: Question) -> list[Answer]:
        """Ask, and give the answers that are there; an earlier question is waited for first."""
        if self._pending is None:
            self._pending = question, self._pool.submit(self._timed, question)
        asked, pending = self._pending
        try:
            found, took_s = pending.result(self._patience_s)
        except TimeoutError:
            self._patience_s = 0.0
            return []
        self._pending = None
        self._patience_s = PATIENCE_S if took_s < PATIENCE_S else 0.0
        return found if asked == question else []

    def close(self) -> None:
        """Wait for the last question; its time is limited."""
        self._pool.shutdown()

    def _timed(self, question: Question) -> tuple[list[Answer], float]:
        started_s = time.monotonic()
        return self._ask(question), time.monotonic() - started_s
