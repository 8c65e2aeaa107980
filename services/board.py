"""What is known of a run: the newest metrics of all its processes, collected from the bus."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from proto.bus import Bus
from proto.codec import encode
from proto.keys import Role
from proto.metrics import (
    METRICS,
    EvaluatorMetrics,
    LearnerMetrics,
    Metrics,
    PolicyScore,
    SuiteScore,
)

M = TypeVar("M", bound=Metrics)
FORGET_AFTER_S: Final = 600.0
"""An actor or a viewer that has been gone for this time is not shown any more."""
_COME_AND_GO: Final = (Role.ACTOR, Role.WATCH)
PROCESSES_KEPT: Final = 10_000
"""A board keeps the metrics of so many processes."""
ProcessKey = tuple[Role, str]
"""Role and id."""


@dataclass(frozen=True)
class RunView:
    """What is known of a run at one moment.

    Attributes:
        run: name of the run.
        metrics: the newest metrics of every process that has published any; those that came last
            are the last.
        vanished_s: Unix time at which a process vanished, of those that have.
    """

    run: str
    metrics: Mapping[ProcessKey, Metrics]
    vanished_s: Mapping[ProcessKey, float]

    def living(self, kind: type[M]) -> list[M]:
        """Metrics of the living processes of one kind, sorted by id."""
        return [
            metrics
            for process, metrics in sorted(self.metrics.items())
            if isinstance(metrics, kind) and process not in self.vanished_s
        ]

    @property
    def scores(self) -> Sequence[PolicyScore]:
        """Success by policy version in the first suite, oldest version first."""
        return self.suites[0].policies if self.suites else ()

    @property
    def suites(self) -> Sequence[SuiteScore]:
        """What was counted in each suite, in the evaluator's newest metrics."""
        evaluators = [m for m in self.metrics.values() if isinstance(m, EvaluatorMetrics)]
        return evaluators[-1].suites if evaluators else ()

    @property
    def policy_version(self) -> int:
        """The newest policy version in the learner's metrics, 0 for none."""
        learners = (m for m in self.metrics.values() if isinstance(m, LearnerMetrics))
        return max((learner.policy_version for learner in learners), default=0)

    def as_json(self) -> dict[str, Any]:
        """The metrics as they were published and the vanished processes, for `json.dumps`."""
        return {
            "run": self.run,
            "processes": [
                json.loads(encode(metrics).payload) for _, metrics in sorted(self.metrics.items())
            ],
            "vanished": [f"{role}/{name}" for role, name in sorted(self.vanished_s)],
        }


class Board:
    """Collects the metrics and the presence of all processes of the bus's run."""

    def __init__(self, bus: Bus, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Start to listen; it ends when the bus is closed.

        Args:
            bus: connection to the run's processes.
            clock: gives the time in seconds; it must not jump.
        """
        self._run = bus.keys.run
        self._clock = clock
        self._changed = threading.Condition()
        self._metrics: dict[ProcessKey, Metrics] = {}
        self._present: set[ProcessKey] = set()
        self._vanished_at_s: dict[ProcessKey, float] = {}  # by the clock
        for role in Role:
            bus.watch_presence(role, self._presence_of(role))
        bus.subscribe(bus.keys.metrics(), self._keep, *METRICS)

    def view(self) -> RunView:
        """What is known at this moment of all processes that are or were present.

        Metrics of a process that never was present are left out: anybody could send them.
        """
        with self._changed:
            self._forget()
            known = self._present | self._vanished_at_s.keys()
            metrics = {process: m for process, m in self._metrics.items() if process in known}
            began_s = time.time() - self._clock()
            vanished = {process: began_s + at_s for process, at_s in self._vanished_at_s.items()}
            return RunView(self._run, metrics, vanished)

    def wait_for_all(self, timeout_s: float) -> RunView:
        """Wait until every living process has published metrics, or the time is up.

        Gives what is known then.
        """
        with self._changed:
            self._changed.wait_for(self._all_known, timeout_s)
        return self.view()

    def _all_known(self) -> bool:
        return bool(self._present) and self._present <= self._metrics.keys()

    def _keep(self, metrics: Metrics) -> None:
        process = (metrics.role, metrics.id)
        with self._changed:
            before = self._metrics.pop(process, None)
            if before is None and len(self._metrics) >= PROCESSES_KEPT:
                return
            self._metrics[process] = metrics
            self._changed.notify_all()

    def _forget(self) -> None:
        """Forget actors and viewers that are gone for good."""
        now_s = self._clock()
        for process, at_s in list(self._vanished_at_s.items()):
            if process[0] in _COME_AND_GO and now_s - at_s >= FORGET_AFTER_S:
                del self._vanished_at_s[process]
                self._metrics.pop(process, None)

    def _presence_of(self, role: Role) -> Callable[[str, bool], None]:
        def on_change(name: str, lives: bool) -> None:
            with self._changed:
                if lives:
                    self._present.add((role, name))
                    self._vanished_at_s.pop((role, name), None)
                else:
                    self._present.discard((role, name))
                    self._vanished_at_s[role, name] = self._clock()
                self._changed.notify_all()

        return on_change
