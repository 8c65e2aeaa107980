"""Figure of what each process of a run did when: who worked, and who waited."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from rich.table import Table

from proto.episode import Kind
from proto.metrics import Stage
from services.figures.style import BLUE, GREEN, GREY, ORANGE, PINK, SKY, YELLOW, figure_style
from services.monitoring.sample import Sample

LEARNER: Final = "learner"
_COLOURS: Final[Mapping[str, str]] = {
    Stage.WAITING: GREY,
    Stage.PRETRAINING: ORANGE,
    Stage.COUPLED: BLUE,
    Kind.TUTORING: GREEN,
    Kind.TRIAL: SKY,
    Kind.PRACTICE: YELLOW,
    Kind.CORRECTION: PINK,
}
_LABEL_SHARE: Final = 0.012
"""Width of a digit of a policy version, as a share of the figure's."""
_LONGEST_GAP_S: Final = 10.0
"""Without a sample for longer, it is not known what the learner did."""


@dataclass(frozen=True)
class Span:
    """What a process did for some time.

    Attributes:
        process: id of the actor, or `learner`.
        what: stage of the training, or kind of the episode.
        start_s, end_s: when, Unix time (s).
    """

    process: str
    what: str
    start_s: float
    end_s: float


@dataclass(frozen=True)
class PlayedEpisode:
    """When an actor played an episode.

    Attributes:
        actor: id of the actor.
        kind: why it was played.
        started_s: when it began, Unix time (s).
        recorded_s: when its recording was written, Unix time (s).
    """

    actor: str
    kind: Kind
    started_s: float
    recorded_s: float


@dataclass(frozen=True)
class Timeline:
    """What the processes of a run did.

    Attributes:
        run: name of the run.
        spans: what each process did, in order of time.
        policies: when each policy version was first seen, Unix time (s), by version.
    """

    run: str
    spans: Sequence[Span]
    policies: Mapping[int, float]

    @classmethod
    def of(cls, run: str, samples: Sequence[Sample], episodes: Iterable[PlayedEpisode]) -> Timeline:
        """Make the timeline of a run from its history and its recordings."""
        last_s = samples[-1].time_s if samples else float("inf")
        spans = [*_learner_spans(samples), *_actor_spans(episodes, last_s)]
        policies: dict[int, float] = {}
        for sample in samples:
            if sample.learner is not None and sample.learner.policy_version:
                policies.setdefault(sample.learner.policy_version, sample.time_s)
        return cls(run, sorted(spans, key=lambda span: span.start_s), policies)

    @property
    def start_s(self) -> float:
        """When the first process did something, Unix time (s)."""
        return min(span.start_s for span in self.spans)

    @property
    def end_s(self) -> float:
        """When the last process did something, Unix time (s)."""
        return max(*(span.end_s for span in self.spans), *self.policies.values(), self.start_s)

    @property
    def processes(self) -> list[str]:
        """The learner, then the actors by their ids."""
        found = {span.process for span in self.spans}
        return sorted(found, key=lambda name: (name != LEARNER, name))

    @property
    def things(self) -> list[str]:
        """Everything that any process did, in the order of a run."""
        done = {span.what for span in self.spans}
        return [what for what in _COLOURS if what in done]

    def seconds(self, process: str) -> dict[str, float]:
        """How long a process did each thing (s); `nothing` is the rest of the run."""
        spent: dict[str, float] = {}
        for span in self.spans:
            if span.process == process:
                spent[span.what] = spent.get(span.what, 0.0) + span.end_s - span.start_s
        idle = self.end_s - self.start_s - sum(spent.values())
        return {**spent, "nothing": max(idle, 0.0)}


def numbers(timeline: Timeline) -> dict[str, Any]:
    """Return the numbers of the figure, for `json.dumps`; times are seconds since its start."""
    return {
        "run": timeline.run,
        "start_s": timeline.start_s,
        "duration_s": timeline.end_s - timeline.start_s,
        "seconds": {process: timeline.seconds(process) for process in timeline.processes},
        "policies_s": {
            version: seen_s - timeline.start_s for version, seen_s in timeline.policies.items()
        },
        "spans": [
            [span.process, span.what, span.start_s - timeline.start_s, span.end_s - span.start_s]
            for span in timeline.spans
        ],
    }


def table(timeline: Timeline) -> Table:
    """Return a table of how long each process did what."""
    duration_s = timeline.end_s - timeline.start_s
    result = Table(title=f"run {timeline.run}: {duration_s:.0f} s")
    for heading in ("process", "did", "seconds"):
        result.add_column(heading, justify="right" if heading == "seconds" else "left")
    for process in timeline.processes:
        spent = timeline.seconds(process)
        done = [what for what in (*timeline.things, "nothing") if what in spent]
        for number, what in enumerate(done):
            result.add_row("" if number else process, what, f"{spent[what]:.0f}")
        result.add_section()
    return result


def draw(timeline: Timeline) -> Figure:
    """Draw a row for each process, and a line for each policy version."""
    processes = timeline.processes
    with figure_style():
        figure = Figure(figsize=(7.2, 0.8 + 0.35 * max(2, len(processes))), layout="constrained")
        axes = figure.subplots()
        for row, process in enumerate(processes):
            spans = [span for span in timeline.spans if span.process == process]
            _draw_row(axes, row, spans, timeline.start_s)
        minutes = (timeline.end_s - timeline.start_s) / 60
        free_from = 0.0
        for version, seen_s in timeline.policies.items():
            minute = (seen_s - timeline.start_s) / 60
            axes.axvline(minute, color="black", linewidth=0.4, linestyle=":")
            if minute < free_from:  # its number would cover the one before
                continue
            free_from = minute + _LABEL_SHARE * len(str(version)) * minutes
            axes.annotate(
                str(version),
                (minute, 1.0),
                xycoords=("data", "axes fraction"),
                ha="center",
                va="bottom",
                fontsize=6,
            )
        axes.set_yticks(range(len(processes)), processes)
        axes.invert_yaxis()
        axes.set_xlim(0, minutes)
        axes.set_xlabel("time (min); dotted: a policy version is published")
        figure.legend(
            handles=[Patch(color=_COLOURS[what], label=what) for what in timeline.things],
            loc="outside upper center",
            ncols=len(timeline.things),
        )
        return figure


def _draw_row(axes: Axes, row: int, spans: Sequence[Span], start_s: float) -> None:
    for what, colour in _COLOURS.items():
        bars = [
            ((span.start_s - start_s) / 60, (span.end_s - span.start_s) / 60)
            for span in spans
            if span.what == what
        ]
        axes.broken_barh(bars, (row - 0.4, 0.8), color=colour, linewidth=0)


def _learner_spans(samples: Sequence[Sample]) -> Iterator[Span]:
    """Yield how long the learner was in each stage; neighbouring samples are joined."""
    told = [(sample.time_s, sample.learner.stage) for sample in samples if sample.learner]
    begun_s: float | None = None
    for (time_s, stage), (next_s, next_stage) in pairwise(told):
        if stage is Stage.FINISHED:
            continue
        begun_s = time_s if begun_s is None else begun_s
        lost = next_s - time_s > _LONGEST_GAP_S
        if next_stage is not stage or lost:
            yield Span(LEARNER, stage, begun_s, time_s if lost else next_s)
            begun_s = None
    if begun_s is not None:
        yield Span(LEARNER, told[-1][1], begun_s, told[-1][0])


def _actor_spans(episodes: Iterable[PlayedEpisode], last_s: float) -> Iterator[Span]:
    """Yield when each episode was played.

    An episode ends when it is recorded, at the latest when its actor begins the next one or when
    the history ends (`last_s`): a recording that was copied seems to be younger than it is.
    """
    by_actor: dict[str, list[PlayedEpisode]] = {}
    for episode in episodes:
        by_actor.setdefault(episode.actor, []).append(episode)
    for actor, played in by_actor.items():
        played.sort(key=lambda episode: episode.started_s)
        next_starts = [*(episode.started_s for episode in played[1:]), float("inf")]
        for episode, next_s in zip(played, next_starts, strict=True):
            end_s = max(min(episode.recorded_s, next_s, last_s), episode.started_s)
            yield Span(actor, episode.kind, episode.started_s, end_s)
