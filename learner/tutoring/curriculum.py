"""Which tutored cases are still to be demonstrated, and which actor demonstrates which."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping, Sequence

from learner.tutoring.failures import Failures, Shown
from proto.config import Config
from proto.episode import Kind
from proto.errors import UserError
from proto.leases import Leases
from proto.messages import EpisodeFailed, TutoringCase

CaseKey = tuple[str, int]
"""Task and seed: what a case and its demonstration have in common."""


class Curriculum:
    """Hands out each case once, and again when its demonstration did not arrive in time.

    The cases of pre-training come first, if they are of another task, then those of the task. Of
    each task the clean executions of all cases come first: training can start with them, and they
    differ most from each other. Used by several threads.
    """

    def __init__(self, config: Config, tutored_cases: Mapping[str, int]) -> None:
        """Plan the cases that the configuration asks for.

        Args:
            config: the configuration.
            tutored_cases: number of tutored cases of each task, by the name of the task.

        Raises:
            UserError: the configuration names a case that the task does not have.
        """
        planned = []
        if config.pretraining_task is not None:
            task, first = config.pretraining_task, config.learner.pretraining
            option = "learner.pretraining.cases"
            planned += _plan(task, tutored_cases[task], first.cases, first.repeats, option)
        task, cases = config.task.name, config.learner.cases
        planned += _plan(task, tutored_cases[task], cases, config.tutor.repeats, "learner.cases")
        self._planned = frozenset(map(_key, planned))
        self._sizes = Counter(case.task for case in planned)
        self._missing = {_key(case): case for case in planned}  # in the order of the plan
        self._leases: Leases[CaseKey] = Leases(config.learner.lease_s)
        self._failures: Failures[CaseKey] = Failures()
        self._lock = threading.Lock()

    @property
    def missing(self) -> int:
        """Number of sequences that are still to come."""
        return len(self._missing)

    def size(self, task: str) -> int:
        """Number of sequences of a task when all have come that can."""
        return self._sizes[task]

    def next_case(self, actor: str) -> TutoringCase | None:
        """A case for this actor to demonstrate; None if none is left."""
        with self._lock:
            key = self._leases.take(actor, self._missing)
            if key is None:
                return None
            self._failures.ask(key, actor)
            return self._missing[key]

    def release(self, actor: str) -> None:
        """Hand out again what an actor that vanished was demonstrating."""
        self._leases.release(actor)

    def refusal(self, shown: Shown) -> str:
        """Why a demonstration belongs to no planned case; empty if it does."""
        if _key(shown) in self._planned:
            return ""
        return f"no tutored case of {shown.task} with the seed {shown.seed} is asked for"

    def wants(self, shown: Shown) -> bool:
        """Whether a sequence is the demonstration of a case that is still missing."""
        with self._lock:
            return self._lacks(shown)

    def keep(self, shown: Shown) -> None:
        """Note that a sequence is kept: its case need not be demonstrated any more."""
        with self._lock:
            if self._lacks(shown):
                del self._missing[_key(shown)]
                self._leases.finish(_key(shown))

    def fail(self, report: EpisodeFailed) -> bool:
        """Note that a case could not be shown; whether the case is given up for that.

        Otherwise it is handed out again. The report of an actor that was not asked is ignored.
        """
        with self._lock:
            if not self._lacks(report):
                return False
            key = _key(report)
            if not self._failures.fail(key, report, self._leases):
                return False
            del self._missing[key]
            self._sizes[report.task] -= 1
            return True

    def _lacks(self, shown: Shown) -> bool:
        return shown.kind is Kind.TUTORING and _key(shown) in self._missing


def _key(case: TutoringCase | Shown) -> CaseKey:
    return case.task, case.seed


def _plan(
    task: str, tutored_cases: int, cases: Sequence[int] | None, repeats: int, option: str
) -> list[TutoringCase]:
    """The repeats of some cases of a task (None: of all); `option` is the key that names them."""
    wanted = range(tutored_cases) if cases is None else cases
    wrong = [case for case in wanted if case >= tutored_cases]
    if wrong:
        raise UserError(
            f"{option}: there is no case {wrong[0]}; the task {task} has the tutored cases "
            f"0 to {tutored_cases - 1}"
        )
    return [
        TutoringCase(task, case, repeat)
        for repeat in range(repeats)
        for case in dict.fromkeys(wanted)
    ]
