"""What all processes of a run are doing: collected from the bus, shown as tables or as lines."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from proto.bus import Bus
from proto.codec import encode
from proto.keys import Role
from proto.metrics import (
    METRICS,
    ActorMetrics,
    EvaluatorMetrics,
    LearnerMetrics,
    Metrics,
    PolicyScore,
    RecorderMetrics,
    Stage,
    Success,
)
from services.terminal.rates import interval_text, percent_text

LINES_PERIOD_S: Final = 5.0
"""How often a line is written where there is no terminal."""
ROWS_SHOWN: Final = 12

M = TypeVar("M", bound=Metrics)
Process = tuple[Role, str]
"""Role and id."""


@dataclass(frozen=True)
class View:
    """What is known at one moment.

    Attributes:
        run: name of the run.
        metrics: the newest metrics of every process that ever told any.
        vanished_s: since when a process is gone (Unix time), for those that are.
    """

    run: str
    metrics: Mapping[Process, Metrics]
    vanished_s: Mapping[Process, float]

    def living(self, kind: type[M]) -> list[M]:
        """Metrics of one kind of process, of those that live, by id."""
        return [
            metrics
            for process, metrics in sorted(self.metrics.items())
            if isinstance(metrics, kind) and process not in self.vanished_s
        ]

    @property
    def scores(self) -> Sequence[PolicyScore]:
        """Success by policy version as last told by the evaluator, oldest version first."""
        told = [m for m in self.metrics.values() if isinstance(m, EvaluatorMetrics)]
        return max(told, key=lambda m: m.time_s).policies if told else ()

    @property
    def policy_version(self) -> int:
        """The newest policy version that the learner told of, 0 for none."""
        told = (m.policy_version for m in self.metrics.values() if isinstance(m, LearnerMetrics))
        return max(told, default=0)

    def as_json(self) -> dict[str, Any]:
        """For `json.dumps`: the metrics as they were told, and who vanished."""
        return {
            "run": self.run,
            "processes": [
                json.loads(encode(metrics).payload) for _, metrics in sorted(self.metrics.items())
            ],
            "vanished": [f"{role}/{name}" for role, name in sorted(self.vanished_s)],
        }


class Board:
    """Keeps what the processes of the bus's run tell."""

    def __init__(self, bus: Bus) -> None:
        """Start listening; it ends when the bus is closed."""
        self._run = bus.keys.run
        self._lock = threading.Lock()
        self._metrics: dict[Process, Metrics] = {}
        self._present: set[Process] = set()
        self._vanished_s: dict[Process, float] = {}
        for role in Role:
            bus.watch_presence(role, self._presence_of(role))
        bus.subscribe(bus.keys.metrics(), self._keep, *METRICS)

    def view(self) -> View:
        """What is known now."""
        with self._lock:
            return View(self._run, dict(self._metrics), dict(self._vanished_s))

    def wait_until_all_told(self, timeout_s: float) -> View:
        """What is known as soon as every process that lives has told its metrics, or in the end."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            with self._lock:
                if self._present and self._present <= self._metrics.keys():
                    break
            time.sleep(0.05)
        return self.view()

    def _keep(self, metrics: Metrics) -> None:
        with self._lock:
            self._metrics[metrics.role, metrics.id] = metrics

    def _presence_of(self, role: Role) -> Callable[[str, bool], None]:
        def on_change(name: str, lives: bool) -> None:
            with self._lock:
                if lives:
                    self._present.add((role, name))
                    self._vanished_s.pop((role, name), None)
                else:
                    self._present.discard((role, name))
                    self._vanished_s[role, name] = time.time()

        return on_change


# --- showing a view ---------------------------------------------------------------------------

Show = Callable[[View], None]


def display(console: Console) -> AbstractContextManager[Show]:
    """What to call with each new view: tables on a terminal, now and then a line elsewhere."""
    return _tables(console) if console.is_terminal else _lines(console)


@contextmanager
def _tables(console: Console) -> Iterator[Show]:
    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
        yield lambda view: live.update(tables(view), refresh=True)


@contextmanager
def _lines(console: Console) -> Iterator[Show]:
    due_s = time.monotonic() + LINES_PERIOD_S
    last = ""

    def show(view: View) -> None:
        nonlocal due_s, last
        line = summary_line(view)
        if time.monotonic() >= due_s and line != last:
            console.print(f"{time.strftime('%H:%M:%S')} {line}", soft_wrap=True, highlight=False)
            due_s, last = time.monotonic() + LINES_PERIOD_S, line

    yield show


def summary_line(view: View) -> str:
    """A view in one line."""
    parts = [
        *map(_learner_words, view.living(LearnerMetrics)),
        _actors_words(view.living(ActorMetrics)),
        *map(_score_words, view.scores[-1:]),
    ]
    if view.vanished_s:
        parts.append("gone: " + ", ".join(f"{role} {name}" for role, name in view.vanished_s))
    return " | ".join(parts)


def success_words(success: Success, trials: int) -> str:
    """Such as `8 of 12, 67 % (39 to 86)`: successes, rate and Wilson interval in percent."""
    rate, interval = percent_text(success.rate, 0), interval_text(success.wilson95, 0)
    return f"{success.successes} of {trials}, {rate} % ({interval})"


def tables(view: View) -> RenderableType:
    """A view as tables."""
    parts: list[RenderableType] = [Text(f"run {view.run}", style="bold")]
    parts += [_learner_table(learner) for learner in view.living(LearnerMetrics)]
    parts.append(_actors_table(view.living(ActorMetrics)))
    if view.scores:
        parts.append(_scores_table(view.scores))
    parts += [
        Text(f"recorder {m.id}: {m.episodes} episodes, {m.bytes / 1e6:.1f} MB, {m.dropped} dropped")
        for m in view.living(RecorderMetrics)
    ]
    parts += [
        Text(f"{role} {name} is gone for {time.time() - since_s:.0f} s", style="red")
        for (role, name), since_s in sorted(view.vanished_s.items())
    ]
    return Group(*parts)


def _stage_words(learner: LearnerMetrics) -> str:
    """Such as `coupled`, `coupled, round 2`, or what it is waiting for."""
    if learner.stage is not Stage.WAITING:
        in_round = learner.round and learner.stage is Stage.COUPLED
        return f"{learner.stage}, round {learner.round}" if in_round else learner.stage
    if not learner.corrections_total:
        return "waiting for sequences"
    return f"waiting for corrections {learner.corrections}/{learner.corrections_total}"


def _learner_words(learner: LearnerMetrics) -> str:
    words = [f"learner {_stage_words(learner)}"]
    if learner.epochs_total:
        words.append(f"epoch {learner.epoch}/{learner.epochs_total}")
    if learner.loss is not None:
        words.append(f"loss {learner.loss:.4f}")
    words.append(f"{learner.sequences} sequences, {learner.epochs_per_s:.1f} epochs/s")
    words.append(f"policy {learner.policy_version}")
    return ", ".join(words)


def _actors_words(actors: Sequence[ActorMetrics]) -> str:
    speed = sum(actor.steps_per_s for actor in actors)
    episodes = sum(actor.episodes for actor in actors)
    count = "1 actor" if len(actors) == 1 else f"{len(actors)} actors"
    return f"{count}, {speed:.0f} steps/s, {episodes} episodes"


def _score_words(score: PolicyScore) -> str:
    return f"policy {score.version} strict {success_words(score.strict, score.trials)}"


def _learner_table(learner: LearnerMetrics) -> Table:
    table = Table("learner", "stage", "epoch", "", "loss", "sequences", "epochs/s", "policy")
    table.add_row(
        learner.id,
        "paused" if learner.paused else _stage_words(learner),
        f"{learner.epoch}/{learner.epochs_total}",
        ProgressBar(total=max(learner.epochs_total, 1), completed=learner.epoch, width=20),
        "" if learner.loss is None else f"{learner.loss:.4f}",
        str(learner.sequences),
        f"{learner.epochs_per_s:.1f}",
        str(learner.policy_version),
    )
    return table


def _actors_table(actors: Sequence[ActorMetrics]) -> Table:
    table = Table("actor", "policy", "steps/s", "episodes", "last episode", "outbox", "simulator")
    for actor in actors[:ROWS_SHOWN]:
        last = f"{actor.last_kind}: {actor.last_outcome}" if actor.last_kind else ""
        table.add_row(
            actor.id,
            str(actor.policy_version),
            f"{actor.steps_per_s:.1f}",
            str(actor.episodes),
            "paused" if actor.paused else last,
            str(actor.outbox),
            actor.backend,
        )
    if len(actors) > ROWS_SHOWN:
        table.caption = f"and {len(actors) - ROWS_SHOWN} more; all: {_actors_words(actors)}"
    return table


def _scores_table(scores: Sequence[PolicyScore]) -> Table:
    table = Table("policy", "trials", "lenient", "strict", "precise", "not precise because")
    for score in reversed(scores[-ROWS_SHOWN:]):
        reasons = sorted(score.reasons.items(), key=lambda item: -item[1])
        table.add_row(
            str(score.version),
            str(score.trials),
            *(success_words(s, score.trials) for s in (score.lenient, score.strict, score.precise)),
            ", ".join(f"{reason} {count}" for reason, count in reasons if reason != "none"),
        )
    return table
