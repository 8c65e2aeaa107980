"""Figure of a run's history: loss, learning rate, success of each policy version, rates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import cycle
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.table import Table

from proto.metrics import Stage
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
_TRAINED: Final[Mapping[Stage, str]] = {
    Stage.PRETRAINING: "pre-training",
    Stage.COUPLED: "coupled training",
    Stage.FINISHED: "coupled training",
}
"""Name of the stage that an epoch belongs to; while the learner waits it is not told."""


@dataclass
class StageCurve:
    """What was sampled of one stage of training, by epoch."""

    loss: dict[int, float] = field(default_factory=dict)
    learning_rate: dict[int, float] = field(default_factory=dict)
    rounds: dict[int, int] = field(default_factory=dict)
    """First sampled epoch of each round of corrections, by its number."""

    def add(self, learner: LearnerSample, loss: float) -> None:
        """Add a sample; an epoch that was computed again after a restart counts once."""
        self.loss[learner.epoch] = loss
        if learner.learning_rate is not None:
            self.learning_rate[learner.epoch] = learner.learning_rate
        if learner.round and learner.stage is not Stage.FINISHED:
            before = self.rounds.get(learner.round, learner.epoch)
            self.rounds[learner.round] = min(before, learner.epoch)


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
        return history

    def _add_training(self, learner: LearnerSample | None) -> None:
        if learner is not None and learner.loss is not None and learner.stage in _TRAINED:
            curve = self.stages.setdefault(_TRAINED[learner.stage], StageCurve())
            curve.add(learner, learner.loss)

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
    """Return a table of the loss of each stage and the success of each policy version."""
    result = Table(title=f"run {history.run}", caption="success in % with the 95 % interval")
    for heading in ("", "trials", *READINGS):
        result.add_column(heading, justify="right" if heading else "left")
    for name, curve in history.stages.items():
        first, last = min(curve.loss), max(curve.loss)
        result.add_row(
            f"{name}, epochs {first} to {last}:"
            f" loss {curve.loss[first]:.4g} to {curve.loss[last]:.4g}"
        )
    for suite, scores in history.scores.items():
        result.add_section()
        for version, score in sorted(scores.items()):
            rates = (Rate(getattr(score, reading), score.trials) for reading in READINGS)
            result.add_row(f"{suite}, policy {version}", str(score.trials), *map(rate_text, rates))
    return result


def draw(history: TrainingHistory) -> Figure:
    """Draw one panel for each kind of number that the history has."""
    panels = list(_panels(history))
    rows = -(-len(panels) // _COLUMNS)
    with figure_style():
        figure = Figure(figsize=(7.2, 2.2 * rows), layout="constrained")
        axes = figure.subplots(rows, _COLUMNS, squeeze=False).flat
        for panel, place in zip(panels, axes, strict=False):
            panel(place)
        for place in list(axes)[len(panels) :]:
            place.remove()
        figure.suptitle(f"run {history.run}")
        return figure


def _panels(history: TrainingHistory) -> Iterator[Callable[[Axes], None]]:
    for name, curve in history.stages.items():
        yield partial(_draw_loss, name=name, curve=curve)
        if curve.learning_rate:
            yield partial(_draw_learning_rate, name=name, curve=curve)
    if any(history.scores.values()):
        yield partial(_draw_success, history=history)
    if any(value for points in history.rates.values() for _, value in points):
        yield partial(_draw_rates, history=history)


def _draw_loss(axes: Axes, name: str, curve: StageCurve) -> None:
    axes.plot(*_columns(curve.loss.items()), color=BLUE)
    if min(curve.loss.values()) > 0:
        axes.set_yscale("log")
    _mark_rounds(axes, curve)
    _label(axes, name, "epoch", "loss")


def _draw_learning_rate(axes: Axes, name: str, curve: StageCurve) -> None:
    axes.plot(*_columns(curve.learning_rate.items()), color=ORANGE)
    axes.set_ylim(bottom=0)
    axes.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3))
    _mark_rounds(axes, curve)
    _label(axes, name, "epoch", "learning rate")


def _mark_rounds(axes: Axes, curve: StageCurve) -> None:
    """Draw a line where each round of corrections begins."""
    for number, epoch in sorted(curve.rounds.items()):
        line = axes.axvline(epoch, color=GREY, linewidth=0.6, linestyle=":")
        if number == min(curve.rounds):
            line.set_label("a round of corrections begins")
    if curve.rounds:
        axes.legend(loc="best")


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
    axes.set_yscale("log")
    axes.legend(loc="best")
    _label(axes, "rates", "time (min)", "per second")


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


def _rates(
    learner: LearnerSample | None, actors: ActorsSample | None
) -> Iterator[tuple[str, float]]:
    if actors is not None:
        yield "control steps", actors.steps_per_s
        yield "episodes", actors.episodes_per_s
    if learner is not None:
        yield "epochs", learner.epochs_per_s
