"""What is known of a run from the bus: its processes, what actors do, how the loss fell."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

from proto.body import FOCUS
from proto.bus import Bus
from proto.codec import encode
from proto.keys import Role
from proto.messages import Live, Pictures
from proto.metrics import (
    METRICS,
    MOST_EPOCHS,
    EpochMetrics,
    EvaluatorMetrics,
    LearnerMetrics,
    Metrics,
    PolicyScore,
    Stage,
    SuiteScore,
)

M = TypeVar("M", bound=Metrics)
FORGET_AFTER_S: Final = 600.0
"""An actor or a viewer that has been gone for this time is not shown any more."""
_COME_AND_GO: Final = (Role.ACTOR, Role.WATCH)
PROCESSES_KEPT: Final = 10_000
"""A board keeps the metrics of so many processes."""
LOSSES_KEPT: Final = 600
"""With more losses, every second one is forgotten."""
STEPS_KEPT: Final = 512
"""A board keeps the last steps of the episode that an actor plays, but not more than these."""
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
        heard_s: Unix time at which the metrics of each process arrived here.
    """

    run: str
    metrics: Mapping[ProcessKey, Metrics]
    vanished_s: Mapping[ProcessKey, float]
    heard_s: Mapping[ProcessKey, float] = field(default_factory=dict)

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


@dataclass(frozen=True)
class Loss:
    """A loss that the learner told.

    Attributes:
        stage: what the learner was doing.
        epoch: epochs done in this stage.
        loss: loss of the last of them.
    """

    stage: str
    epoch: int
    loss: float


class _Losses:
    """The losses that a learner told, in the order of its training; thinned out as they grow."""

    def __init__(self) -> None:
        self.kept: list[Loss] = []
        self._every = 1
        self._told = 0

    def add(self, metrics: LearnerMetrics) -> None:
        if metrics.loss is None or metrics.stage not in (Stage.PRETRAINING, Stage.COUPLED):
            return
        told = Loss(metrics.stage, metrics.epoch, metrics.loss)
        if self.kept and self.kept[-1] == told:
            return
        self._told += 1
        if self._told % self._every:
            return
        self.kept.append(told)
        if len(self.kept) > LOSSES_KEPT:
            self.kept = self.kept[::2]
            self._every *= 2


class _Epochs:
    """The epochs of a training that a learner told and nobody has taken, at most the newest."""

    def __init__(self) -> None:
        self._training = ""
        self._waiting: deque[EpochMetrics] = deque(maxlen=MOST_EPOCHS)

    def add(self, metrics: LearnerMetrics) -> None:
        if metrics.training != self._training:
            self._training = metrics.training
            self._waiting.clear()
        self._waiting.extend(metrics.epochs)

    def taken(self) -> tuple[EpochMetrics, ...]:
        taken = tuple(self._waiting)
        self._waiting.clear()
        return taken


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
        self._heard_s: dict[ProcessKey, float] = {}
        self._losses = _Losses()
        self._epochs = _Epochs()
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
            heard_s = {process: self._heard_s[process] for process in metrics}
            began_s = time.time() - self._clock()
            vanished = {process: began_s + at_s for process, at_s in self._vanished_at_s.items()}
            return RunView(self._run, metrics, vanished, heard_s)

    @property
    def losses(self) -> Sequence[Loss]:
        """The losses that the learner has told since this board listens."""
        with self._changed:
            return list(self._losses.kept)

    def take_epochs(self) -> tuple[EpochMetrics, ...]:
        """The epochs that the learner has told since the last call, at most MOST_EPOCHS."""
        with self._changed:
            return self._epochs.taken()

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
            self._heard_s[process] = time.time()
            if isinstance(metrics, LearnerMetrics) and process in self._present:
                self._losses.add(metrics)
                self._epochs.add(metrics)
            self._changed.notify_all()

    def _forget(self) -> None:
        """Forget actors and viewers that are gone for good."""
        now_s = self._clock()
        for process, at_s in list(self._vanished_at_s.items()):
            if process[0] in _COME_AND_GO and now_s - at_s >= FORGET_AFTER_S:
                del self._vanished_at_s[process]
                self._metrics.pop(process, None)
                self._heard_s.pop(process, None)

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


@dataclass(frozen=True)
class ActorView:
    """What an actor does at one moment.

    Attributes:
        live: its newest control step.
        episode: number of the episode, counted from 1 since it is watched.
        focus: focus level at which the picture of this step was taken.
        path: of each step of the episode that was heard, in their order.
    """

    live: Live
    episode: int
    focus: float
    path: Sequence[Live]


@dataclass
class _Watched:
    """An actor that is watched.

    Attributes:
        end: ends the subscription.
        path: the steps of its episode.
        episode: number of the episode.
        focus: focus level of the newest picture.
    """

    end: Callable[[], None]
    path: deque[Live] = field(default_factory=lambda: deque(maxlen=STEPS_KEPT))
    episode: int = 0
    focus: float = 0.0


class LiveBoard:
    """Collects what some actors of the bus's run do: each control step, and pictures on demand.

    Actors publish these only while somebody subscribes, so nothing is subscribed to that nobody
    looks at.
    """

    def __init__(self, bus: Bus, start_focus: float) -> None:
        """Subscribe to nothing yet.

        Args:
            bus: connection to the run.
            start_focus: focus level at which every episode starts.
        """
        self._bus = bus
        self._start_focus = start_focus
        self._lock = threading.Lock()
        self._watched: dict[str, _Watched] = {}
        self._filmed: dict[str, Callable[[], None]] = {}
        self._pictures: dict[str, Pictures] = {}

    def watch(self, actors: Collection[str], filmed: Collection[str] = ()) -> None:
        """Choose whom to watch; what is known of others is forgotten.

        Args:
            actors: ids of the actors whose steps are wanted.
            filmed: ids of the actors whose pictures are wanted.
        """
        keys, ended = self._bus.keys, []
        with self._lock:
            ended += [self._watched.pop(name).end for name in self._watched.keys() - set(actors)]
            for name in self._filmed.keys() - set(filmed):
                ended.append(self._filmed.pop(name))
                self._pictures.pop(name, None)
            for name in set(actors) - self._watched.keys():
                end = self._bus.listen(keys.live(name), self._on_live, Live)
                self._watched[name] = _Watched(end)
            for name in set(filmed) - self._filmed.keys():
                end = self._bus.listen(keys.pictures(name), self._on_pictures, Pictures)
                self._filmed[name] = end
        for end in ended:
            end()

    def actors(self) -> Mapping[str, ActorView]:
        """What the watched actors do, of those that have been heard."""
        with self._lock:
            return {
                name: ActorView(each.path[-1], each.episode, each.focus, tuple(each.path))
                for name, each in self._watched.items()
                if each.path
            }

    def pictures(self, actor: str) -> Pictures | None:
        """The newest pictures of an actor; None if there are none."""
        with self._lock:
            return self._pictures.get(actor)

    def _on_live(self, live: Live) -> None:
        with self._lock:
            watched = self._watched.get(live.actor)
            if watched is None:  # it is not watched any more
                return
            last = watched.path[-1] if watched.path else None
            if last is None or live.step <= last.step:
                watched.path.clear()
                watched.episode += 1
            # The picture of a step was taken with the focus that the step before commanded.
            follows = last is not None and live.step == last.step + 1
            if follows and last is not None:
                watched.focus = float(last.action[FOCUS])
            else:
                watched.focus = float(live.action[FOCUS]) if live.step else self._start_focus
            watched.path.append(live)

    def _on_pictures(self, pictures: Pictures) -> None:
        with self._lock:
            if pictures.actor in self._filmed:
                self._pictures[pictures.actor] = pictures
