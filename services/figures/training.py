"""Figure of a run's history: loss, learning rate, success of each policy version, rates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import cycle
from statistics import fmean
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter
from rich.table import Table

from proto.metrics import EpochMetrics, Stage
from services.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    RED,
    SKY,
    figure_style,
    percent,
)
from services.monitoring.sample import ActorsSample, LearnerSample, Sample, ScoreSample
from services.terminal.rates import rate_text
from services.trials.success import READINGS, Rate

_COLOURS: Final = (BLUE, ORANGE, GREEN, PINK, SKY, RED, BLACK)
_MARKERS: Final = "osD^vPX"
_COLUMNS: Final = 2
_DECADE: Final = 10
_RATES_SHOWN: Final = 60
"""Rates are averaged over so many equal parts of the time."""
_STAGES: Final[Mapping[Stage, str]] = {
    Stage.PRETRAINING: "pre-training",
    Stage.COUPLED: "coupled training",
}


@dataclass
class StageCurve:
    """What was sampled of one stage of training, by epoch."""

    loss: dict[int, float] = field(default_factory=dict)
    learning_rate: dict[int, float] = field(default_factory=dict)
    rounds: dict[int, int] = field(default_factory=dict)
    """First sampled epoch of each round of corrections, by its number."""

    def add(self, epoch: EpochMetrics, number: int) -> None:
        """Add an epoch of a round; one that was computed again after a restart counts once."""
        self.loss[epoch.epoch] = epoch.loss
        self.learning_rate[epoch.epoch] = epoch.learning_rate
        if number:
            self.rounds[number] = min(self.rounds.get(number, epoch.epoch), epoch.epoch)


@dataclass
class TrainingHistory:
    """The history of the newest training of a run.

    Attributes:
        run: name of the run.
        damaged: number of lines of the history that could not be read.
        stages: what was sampled of each stage, by its name.
        scores: the newest score by suite and policy version.
        rates: values over time by name: minutes since the first sample, and the value.
    """

    run: str
    damaged: int
    stages: dict[str, StageCurve] = field(default_factory=dict)
    scores: dict[str, dict[int, ScoreSample]] = field(default_factory=dict)
    rates: dict[str, list[tuple[float, float]]] = field(default_factory=dict)

    @classmethod
    def of(cls, run: str, samples: Sequence[Sample], damaged: int = 0) -> TrainingHistory:
        """Sort the samples of a run, oldest first."""
        history = cls(run, damaged)
        recent = _of_newest_training(samples)
        for sample in recent:
            history._add_training(sample.learner)
            for name, value in _rates(sample.learner, sample.actors):
                minutes = (sample.time_s - recent[0].time_s) / 60
                history.rates.setdefault(name, []).append((minutes, value))
            for score in sample.scores:
                history.scores.setdefault(score.suite, {})[score.version] = score
        history.rates = {name: _averages(points) for name, points in history.rates.items()}
        return history

    def _add_training(self, learner: LearnerSample | None) -> None:
        if learner is None:
            return
        # While the learner waits, its round is that of the next epochs.
        number = 0 if learner.stage is Stage.WAITING else learner.round
        for epoch in learner.epochs:
            self.stages.setdefault(_STAGES[epoch.stage], StageCurve()).add(epoch, number)

    def rates_of(self, suite: str, reading: str) -> Mapping[int, Rate]:
        """Success by policy version, in one of READINGS."""
        return {
            version: Rate(getattr(score, reading), score.trials)
            for version, score in sorted(self.scores[suite].items())
            if score.trials
        }


def numbers(history: TrainingHistory) -> dict[str, Any]:
    """Return the numbers of the figure, for `json.dumps`."""
    return {
        "run": history.run,
        "damaged_lines": history.damaged,
        "stages": {
            name: {
                "loss": sorted(curve.loss.items()),
                "learning_rate": sorted(curve.learning_rate.items()),
                "rounds": curve.rounds,
            }
            for name, curve in history.stages.items()
        },
        "success": {
            suite: [
                {
                    "policy_version": version,
                    "trials": score.trials,
                    **{
                        reading: Rate(getattr(score, reading), score.trials).as_json()
                        for reading in READINGS
                    },
                }
                for version, score in sorted(scores.items())
            ]
            for suite, scores in history.scores.items()
        },
        "rates_by_minute": history.rates,
    }


def table(history: TrainingHistory) -> Table:
    """Return a table of the success of each policy version, with the losses below it."""
    losses = [_loss_words(name, curve) for name, curve in history.stages.items()]
    result = Table(title=f"run {history.run}", caption="\n".join(losses))
    several = len(history.scores) > 1
    if several:
        result.add_column("suite")
    for heading in ("policy", "trials", *READINGS):
        result.add_column(heading, justify="right")
    for suite, scores in history.scores.items():
        for version, score in sorted(scores.items()):
            rates = (Rate(getattr(score, reading), score.trials) for reading in READINGS)
            result.add_row(
                *((suite,) if several else ()),
                str(version),
                str(score.trials),
                *(rate_text(rate, digits=0) for rate in rates),
            )
        result.add_section()
    return result


def _loss_words(name: str, curve: StageCurve) -> str:
    first, last = min(curve.loss), max(curve.loss)
    return (
        f"{name}, epochs {first} to {last}: loss {curve.loss[first]:.4g} to {curve.loss[last]:.4g}"
    )


def draw(history: TrainingHistory) -> Figure:
    """Draw one panel for each kind of number that the history has."""
    panels = list(_panels(history))
    rows = -(-len(panels) // _COLUMNS)
    with figure_style():
        figure = Figure(figsize=(7.2, 2.2 * rows), layout="constrained")
        places = list(figure.subplots(rows, _COLUMNS, squeeze=False).flat)
        for panel, axes in zip(panels, places, strict=False):
            panel(axes)
        for axes in places[len(panels) :]:
            axes.remove()
        figure.suptitle(f"run {history.run}")
        return figure


def _panels(history: TrainingHistory) -> Iterator[Callable[[Axes], None]]:
    for name, curve in history.stages.items():
        yield partial(_draw_loss, name=name, curve=curve)
        yield partial(_draw_learning_rate, name=name, curve=curve)
    if any(history.scores.values()):
        yield partial(_draw_success, history=history)
    if any(value for points in history.rates.values() for _, value in points):
        yield partial(_draw_rates, history=history)


def _draw_loss(axes: Axes, name: str, curve: StageCurve) -> None:
    axes.plot(*_columns(curve.loss.items()), color=BLUE)
    if max(curve.loss.values()) > _DECADE * min(curve.loss.values()) > 0:
        _make_logarithmic(axes)
    _mark_rounds(axes, curve)
    if curve.rounds:
        axes.legend(loc="best")
    _label(axes, name, "epoch", "loss")


def _draw_learning_rate(axes: Axes, name: str, curve: StageCurve) -> None:
    axes.plot(*_columns(curve.learning_rate.items()), color=ORANGE)
    axes.set_ylim(bottom=0)
    axes.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3))
    _mark_rounds(axes, curve)
    _label(axes, name, "epoch", "learning rate")


def _mark_rounds(axes: Axes, curve: StageCurve) -> None:
    """Draw a line where each round of corrections begins."""
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    for number, epoch in sorted(curve.rounds.items()):
        line = axes.axvline(epoch, color=GREY, linewidth=0.6, linestyle=":")
        if number == min(curve.rounds):
            line.set_label("a round of corrections begins")


def _draw_success(axes: Axes, history: TrainingHistory) -> None:
    """Draw strict success of each suite against the policy version."""
    styles = zip(cycle(_COLOURS), cycle(_MARKERS), strict=False)
    for suite, (colour, marker) in zip(history.scores, styles, strict=False):
        rates = history.rates_of(suite, "strict")
        if not rates:
            continue
        middle, reach = percent(rates.values())
        axes.errorbar(
            list(rates),
            middle,
            yerr=reach,
            label=suite,
            color=colour,
            marker=marker,
            linewidth=1.0,
            markersize=3.5,
            elinewidth=0.8,
            capsize=2,
        )
    axes.set_ylim(0, 102)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(title="suite", loc="best")
    _label(axes, "trials of each policy version", "policy version", "strict success (%)")


def _draw_rates(axes: Axes, history: TrainingHistory) -> None:
    for (name, points), colour in zip(history.rates.items(), cycle(_COLOURS), strict=False):
        minutes, values = _columns(points)
        if not any(values):  # nothing that a logarithmic axis can show
            continue
        axes.plot(minutes, [value or math.nan for value in values], label=name, color=colour)
    _make_logarithmic(axes)
    axes.legend(loc="best")
    _label(axes, "rates", "time (min)", "per second")


def _make_logarithmic(axes: Axes) -> None:
    """Make the upward axis logarithmic, with plain numbers."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def _label(axes: Axes, title: str, across: str, up: str) -> None:
    axes.set_title(title)
    axes.set_xlabel(across)
    axes.set_ylabel(up)


def _columns(points: Iterable[tuple[float, float]]) -> tuple[list[float], list[float]]:
    """Split points, sorted by their first coordinate."""
    across, up = zip(*sorted(points), strict=True)
    return list(across), list(up)


def _of_newest_training(samples: Sequence[Sample]) -> Sequence[Sample]:
    """The samples since the newest training began."""
    named = [number for number, sample in enumerate(samples) if sample.learner is not None]
    if not named:
        return samples
    newest = _training(samples[named[-1]])
    others = [number for number in named if _training(samples[number]) != newest]
    return samples[others[-1] + 1 :] if others else samples


def _training(sample: Sample) -> str:
    return "" if sample.learner is None else sample.learner.training


def _averages(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Mean place and value of the points in each of _RATES_SHOWN equal parts."""
    first, last = points[0][0], max(point[0] for point in points)
    width = max((last - first) / _RATES_SHOWN, 1e-9)
    parts: dict[int, list[tuple[float, float]]] = {}
    for point in points:
        parts.setdefault(int((point[0] - first) / width), []).append(point)
    return [(fmean(p for p, _ in part), fmean(v for _, v in part)) for part in parts.values()]


def _rates(
    learner: LearnerSample | None, actors: ActorsSample | None
) -> Iterator[tuple[str, float]]:
    if actors is not None:
        yield "control steps", actors.steps_per_s
        yield "episodes", actors.episodes_per_s
    if learner is not None:
        yield "epochs", learner.epochs_per_s
