"""Figure of the situations in which a policy fails.

It shows whether a policy fails near tutored values of a variable or between them. A network that
snaps to tutored values acts as if the nearest tutored value were the real one. Its errors are
largest midway between two tutored values: they follow a sawtooth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, cycle, pairwise
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from actors.tasks.contract import FigureWords, GraspError, Task
from proto.episode import NO_FAILURE, Outcome
from proto.errors import UserError
from proto.variables import Discrete, Situation, Value, Variable
from services.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    READING_COLOURS,
    RED,
    figure_style,
    label,
    percent,
    show_percent,
    words_and_unit,
)
from services.terminal.rates import rate_text
from services.trials.success import Rate
from services.trials.trial_log import CountedTrial

Array = NDArray[np.float64]

READINGS: Final = ("strict", "precise")
SHOWN: Final = 2.5
"""Largest error that is shown, in multiples of the allowed error; larger ones are clipped."""
_MARKS: Final = ((GREEN, "o"), (ORANGE, "o"), (BLUE, "^"), (BLACK, "x"), (RED, "s"), (PINK, "D"))
"""Colour and marker of each of the task's reasons in their order; repeated if there are more."""
_READING_MARKS: Final[Mapping[str, str]] = {"strict": "o", "precise": "D"}
MOST_CHOICES: Final = 12
"""A discrete variable with more choices, such as one of hundreds of clips, is not drawn."""
_MAPS_IN_A_ROW: Final = 3
_Z95: Final = 1.96
_EXPLANATION: Final = (
    "Dotted: tutored values. Errors are shown for trials in which the object had not moved before"
    " the hand closed;\nlarger errors are drawn at the edge. Grey: approximate range of a precise"
    " grasp. Black: a policy that acts for the nearest tutored value."
)


@dataclass(frozen=True)
class Axis:
    """A variable of the task as an axis of the figure.

    Attributes:
        variable: the variable.
        values: (N,) its value in each trial; for a discrete variable the index of the choice.
        tutored: its tutored values in ascending order.
    """

    variable: Variable
    values: Array
    tutored: Array

    @classmethod
    def of(cls, variable: Variable, trials: Sequence[CountedTrial], task: Task) -> Axis:
        """Make the axis of a variable."""

        def number(value: Value) -> float:
            if isinstance(variable, Discrete):
                return variable.choices.index(str(value))
            return float(value)

        values = [number(trial.situation[variable.name]) for trial in trials]
        tutored = {number(case[variable.name]) for case in task.tutored()}
        return cls(variable, np.array(values, np.float64), np.array(sorted(tutored), np.float64))

    @property
    def discrete(self) -> bool:
        """Whether the variable is discrete, so that there are no values between two others."""
        return isinstance(self.variable, Discrete)

    @property
    def is_shown(self) -> bool:
        """Whether the figure and the table show the variable."""
        return not isinstance(self.variable, Discrete) or len(self.variable.choices) <= MOST_CHOICES


@dataclass(frozen=True)
class Trials:
    """N trials of one policy, and the tutored values.

    Attributes:
        axes: by name, the variables with several tutored values.
        situations: situation of each trial.
        outcomes: outcome of each trial.
        words: labels and errors of the task.
    """

    axes: Mapping[str, Axis]
    situations: Sequence[Situation]
    outcomes: Sequence[Outcome]
    words: FigureWords

    @classmethod
    def of(cls, trials: Sequence[CountedTrial], task: Task) -> Trials:
        """Collect trials of a task.

        Raises:
            UserError: there is no trial, or one is of another task.
        """
        if not trials:
            raise UserError(
                "there is no trial to draw; `vmdnn evaluate --outcomes FILE` plays and saves trials"
            )
        for trial in trials:
            task.check(trial.situation)
        axes = {each.name: Axis.of(each, trials, task) for each in task.variables}
        axes = {name: axis for name, axis in axes.items() if len(axis.tutored) > 1}
        if not any(axis.is_shown for axis in axes.values()):
            raise UserError(f"task {task.name} has no variable along which failures can be drawn")
        return cls(
            axes=axes,
            situations=[trial.situation for trial in trials],
            outcomes=[trial.outcome for trial in trials],
            words=task.figure_words,
        )

    @property
    def shown(self) -> list[Axis]:
        """The axes that the figure and the table show."""
        return [axis for axis in self.axes.values() if axis.is_shown]

    def succeeded(self, reading: str) -> NDArray[np.bool_]:
        """Return (N,) whether each trial succeeded in a reading."""
        return np.array([getattr(outcome, reading) for outcome in self.outcomes], dtype=np.bool_)

    def ended_with(self, reason: str) -> NDArray[np.bool_]:
        """Return (N,) whether each trial ended with this reason."""
        return np.array([outcome.reason == reason for outcome in self.outcomes], dtype=np.bool_)

    def betweenness(self, name: str) -> Array:
        """Return (N,) the distance to the nearest tutored value: 0 at one, 1 midway between two."""
        axis = self.axes[name]
        tutored, values = axis.tutored, axis.values
        upper = np.clip(np.searchsorted(tutored, values), 1, len(tutored) - 1)
        below, above = tutored[upper - 1], tutored[upper]
        return 2 * np.minimum(np.abs(values - below), np.abs(above - values)) / (above - below)

    def to_nearest(self, name: str) -> Array:
        """Return (N,) the nearest tutored value minus the value of each trial."""
        axis = self.axes[name]
        nearest = axis.tutored[np.abs(axis.values[:, None] - axis.tutored).argmin(axis=1)]
        result: Array = nearest - axis.values
        return result

    def rate(self, reading: str, chosen: NDArray[np.bool_]) -> Rate:
        """Return the success rate in one reading of the trials where `chosen` (N,) is true."""
        return Rate(int(self.succeeded(reading)[chosen].sum()), int(chosen.sum()))

    def approached(self) -> NDArray[np.bool_]:
        """Return (N,) whether the object had not moved before the hand closed."""
        in_place = (
            bool(outcome.measures) and self.words.in_place(outcome) for outcome in self.outcomes
        )
        return np.array(list(in_place), dtype=np.bool_)

    def reached(self) -> NDArray[np.bool_]:
        """Return (N,) whether, in addition, all errors were small enough to be shown."""
        reached = self.approached()
        for error in self.words.errors:
            reached &= np.abs(self.error(error)) < SHOWN * error.allowed
        return reached

    def error(self, error: GraspError) -> Array:
        """Return (N,) an error of the grasp in each trial; NaN if it was not measured."""
        pairs = zip(self.outcomes, self.situations, strict=True)
        errors = [
            error.measure(outcome, situation) if outcome.measures else np.nan
            for outcome, situation in pairs
        ]
        return np.array(errors, dtype=np.float64)


@dataclass(frozen=True)
class Snapping:
    """How far a policy shifts its grasp to the nearest tutored value.

    Attributes:
        share: shift as a fraction of the distance to the nearest tutored value: 0 for a policy that
            interpolates, 1 for one that acts for the nearest tutored value.
        half_width: half the width of the 95 % interval of `share`.
        trials: number of trials that it was estimated from.
    """

    share: float
    half_width: float
    trials: int


def snapping(trials: Trials, name: str) -> Snapping | None:
    """Estimate how far a policy snaps to the tutored values of a variable.

    The estimate is the least-squares coefficient of the error on the distance to the nearest
    tutored value. The regression includes a constant error and one proportional to the value, such
    as a bias to the middle of the range, so that they do not count as snapping.

    Returns:
        The estimate; None if the task has no error for the variable, or with too few trials.
    """
    shown_by = next((each for each in trials.words.errors if each.variable == name), None)
    if shown_by is None:
        return None
    error = trials.error(shown_by) / shown_by.per_unit
    chosen = trials.reached()
    columns = (np.ones(len(error)), trials.axes[name].values, trials.to_nearest(name))
    causes = np.stack(columns, axis=1)[chosen]
    count, unknowns = causes.shape
    if count < 2 * unknowns or np.linalg.matrix_rank(causes) < unknowns:
        return None
    effects, *_ = np.linalg.lstsq(causes, error[chosen], rcond=None)
    variance = np.square(error[chosen] - causes @ effects).sum() / (count - unknowns)
    deviation = np.sqrt(variance * np.linalg.inv(causes.T @ causes)[-1, -1])
    return Snapping(float(effects[-1]), float(_Z95 * deviation), count)


def numbers(trials: Trials) -> dict[str, Any]:
    """Return the numbers of the figure, for `json.dumps`."""
    found = {name: snapping(trials, name) for name in trials.axes}
    return {
        "trials": len(trials.outcomes),
        "near_and_between": {
            name: {
                place: {reading: _rate_json(trials.rate(reading, chosen)) for reading in READINGS}
                for place, chosen in _places(trials, name).items()
            }
            for name, axis in trials.axes.items()
            if not axis.discrete
        },
        "by_value": {
            name: [
                {
                    **each.limits(axis),
                    **{
                        reading: _rate_json(trials.rate(reading, each.chosen))
                        for reading in READINGS
                    },
                }
                for each in _bins(axis)
            ]
            for name, axis in trials.axes.items()
        },
        "snapping": {name: vars(each) for name, each in found.items() if each is not None},
    }


def table(trials: Trials) -> Table:
    """Return a table of success near tutored values and between them, and of snapping."""
    result = Table(
        caption="near: within a quarter of the spacing of a tutored value; snapping: 0 for none,"
        " 1 for a policy that acts for the nearest tutored value"
    )
    headings = (f"{reading} {place} %" for reading in READINGS for place in ("near", "between"))
    for heading in ("value", *headings, "snapping"):
        result.add_column(heading, justify="left" if heading == "value" else "right")
    for axis in trials.shown:
        name = axis.variable.name
        if axis.discrete:
            _add_choices(result, trials, axis)
            continue
        places = _places(trials, name)
        cells = [
            rate_text(trials.rate(reading, chosen), digits=0)
            for reading in READINGS
            for chosen in places.values()
        ]
        found = snapping(trials, name)
        text = "" if found is None else f"{found.share:.2f} ± {found.half_width:.2f}"
        result.add_row(words_and_unit(name)[0], *cells, text)
    return result


def _add_choices(result: Table, trials: Trials, axis: Axis) -> None:
    """Add a row with the success for each choice of a discrete variable."""
    for each in _bins(axis):
        if not each.chosen.any():
            continue
        strict, precise = (
            rate_text(trials.rate(reading, each.chosen), digits=0) for reading in READINGS
        )
        result.add_row(f"{words_and_unit(axis.variable.name)[0]} {each.name}", strict, "", precise)


def draw(trials: Trials, title: str) -> Figure:
    """Draw maps of the outcomes, success by value of each variable, and errors of the grasp."""
    with figure_style():
        axes_shown, errors = trials.shown, trials.words.errors
        maps = _maps(axes_shown)
        map_rows = -(-len(maps) // _MAPS_IN_A_ROW)
        size = (max(9.0, 1.75 * len(axes_shown)), 9.6 + 2.4 * map_rows)
        figure = Figure(figsize=size, layout="constrained")
        figure.suptitle(title, fontsize=10)
        rows: Any = figure.subfigures(2, 1, height_ratios=[1.15 * map_rows, 4.6])
        _draw_maps(rows[0], trials, maps, map_rows)
        axes = rows[1].subplots(
            1 + len(errors), len(axes_shown), sharex="col", sharey="row", squeeze=False
        )
        for column, axis in zip(axes.T, axes_shown, strict=True):
            _draw_rates(column[0], trials, axis)
            for each, error in zip(column[1:], errors, strict=True):
                _draw_errors(each, trials, axis, error)
            _label_axis(column[-1].xaxis, column[-1].set_xlabel, axis)
        show_percent(axes[0, 0], _lowest(trials))  # the panels of a row share their axis
        axes[0, 0].set_ylabel("success (%)")
        for row, error in zip(axes[1:], errors, strict=True):
            row[0].set_ylabel(error.label)
        axes[0, 0].legend(loc="lower left", ncols=2)
        rows[1].supxlabel(_EXPLANATION, fontsize=8)
        rows[1].align_ylabels(axes[:, 0])
        return figure


def _marks(trials: Trials) -> Iterator[tuple[str, str, str, str]]:
    """Yield each reason of an outcome with its label, colour and marker."""
    known = dict(trials.words.reasons)
    for outcome in trials.outcomes:
        known.setdefault(outcome.reason, outcome.reason.replace("_", " "))
    for (reason, words), (colour, marker) in zip(known.items(), cycle(_MARKS), strict=False):
        yield reason, words, colour, marker


def _maps(shown: Sequence[Axis]) -> list[tuple[Axis, Axis]]:
    """The axes of each map: pairs of continuous variables, if there are two, or of all."""
    continuous = [axis for axis in shown if not axis.discrete]
    pairs = combinations(continuous if len(continuous) > 1 else shown, 2)
    return list(pairs) or [(shown[0], shown[0])]


def _draw_maps(
    figure: Any, trials: Trials, maps: Sequence[tuple[Axis, Axis]], map_rows: int
) -> None:
    axes = figure.subplots(map_rows, min(len(maps), _MAPS_IN_A_ROW), squeeze=False).ravel()
    for each in axes[len(maps) :]:
        each.remove()
    for each, (across, up) in zip(axes, maps, strict=False):
        for reason, words, colour, marker in _marks(trials):
            chosen = trials.ended_with(reason)
            precise = reason == NO_FAILURE
            each.scatter(
                across.values[chosen],
                up.values[chosen],
                s=7 if precise else 14,
                color=colour,
                marker=marker,
                linewidths=0.8 if marker == "x" else 0,
                alpha=0.35 if precise else 0.9,
                label=f"{words} ({chosen.sum()})" if chosen.any() else None,
            )
        _label_axis(each.xaxis, each.set_xlabel, across)
        _label_axis(each.yaxis, each.set_ylabel, up)
        _mark_tutored(each.axvline, across.tutored)
        _mark_tutored(each.axhline, up.tutored)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), columnspacing=1.2)


def _label_axis(side: Any, set_label: Callable[[str], object], axis: Axis) -> None:
    """Label an axis of a panel; for a discrete variable its ticks are the names of the choices."""
    set_label(label(axis.variable.name))
    if isinstance(axis.variable, Discrete):
        side.set_ticks(range(len(axis.variable.choices)), axis.variable.choices)


def _draw_rates(axes: Axes, trials: Trials, axis: Axis) -> None:
    bins = [each for each in _bins(axis) if each.chosen.any()]
    centres = np.array([(each.low + each.high) / 2 for each in bins])
    offset = 0.06 * float(np.diff(axis.tutored).min())
    for side, reading in enumerate(READINGS):
        middle, reach = percent(trials.rate(reading, each.chosen) for each in bins)
        axes.errorbar(
            centres + (2 * side - 1) * offset,
            middle,
            yerr=reach,
            color=READING_COLOURS[reading],
            marker=_READING_MARKS[reading],
            markersize=3.5,
            # Where both are equal, both lines are seen: the second is dashed, on the first.
            linewidth=0.0 if axis.discrete else (1.0, 1.4)[side],
            linestyle=("solid", (0, (3, 3)))[side],
            elinewidth=0.8,
            label=reading,
        )
    _mark_tutored(axes.axvline, axis.tutored)


def _lowest(trials: Trials) -> float:
    """The lowest end of an interval of success (percent)."""
    return 100 * min(
        trials.rate(reading, each.chosen).wilson95[0]
        for axis in trials.shown
        for reading in READINGS
        for each in _bins(axis)
        if each.chosen.any()
    )


def _draw_errors(axes: Axes, trials: Trials, axis: Axis, error: GraspError) -> None:
    allowed = error.allowed
    limit = SHOWN * allowed
    chosen, values = trials.approached(), axis.values
    errors = np.clip(trials.error(error), -0.97 * limit, 0.97 * limit)  # all are shown
    axes.axhspan(-allowed, allowed, color=GREY, alpha=0.15, linewidth=0)
    axes.axhline(0, color=GREY, linewidth=0.5)
    for reason, _, colour, _ in _marks(trials):
        shown = chosen & trials.ended_with(reason)
        axes.scatter(values[shown], errors[shown], s=4, color=colour, alpha=0.5, linewidths=0)
    if error.variable == axis.variable.name:
        corners, snapped = _sawtooth(axis.tutored)
        axes.plot(corners, error.per_unit * snapped, color=BLACK, linewidth=0.7)
    axes.set_ylim(-limit, limit)
    axes.set_yticks([-2 * allowed, -allowed, 0, allowed, 2 * allowed])
    _mark_tutored(axes.axvline, axis.tutored)


def _sawtooth(tutored: Array) -> tuple[Array, Array]:
    """Return the corners of the sawtooth: values, and the errors there of a policy that snaps."""
    values, errors = [], []
    for below, above in pairwise(tutored):
        middle = (below + above) / 2
        values += [below, middle, middle, above]
        errors += [0.0, below - middle, above - middle, 0.0]
    return np.array(values), np.array(errors)


def _mark_tutored(line: Any, tutored: Iterable[float]) -> None:
    for value in tutored:
        line(value, color=GREY, linewidth=0.5, linestyle=(0, (2, 2)), zorder=0)


@dataclass(frozen=True)
class _Bin:
    """A range of a variable's values.

    Attributes:
        name: the choice of a discrete variable; empty for a continuous variable.
        low: lower end of the range.
        high: upper end of the range.
        chosen: (N,) whether each trial is in the range.
    """

    name: str
    low: float
    high: float
    chosen: NDArray[np.bool_]

    def limits(self, axis: Axis) -> dict[str, Any]:
        """Return the choice or the ends of the range, for `json.dumps`."""
        return {"choice": self.name} if axis.discrete else {"from": self.low, "to": self.high}


def _bins(axis: Axis) -> list[_Bin]:
    """Divide the values into ranges that are alternately near and between tutored values.

    The ranges of a discrete variable are its choices.
    """
    if isinstance(axis.variable, Discrete):
        return [
            _Bin(choice, number, number, axis.values == number)
            for number, choice in enumerate(axis.variable.choices)
        ]
    tutored = axis.tutored
    edges = [tutored[0]]
    for below, above in pairwise(tutored):
        edges += [below + (above - below) / 4, below + 3 * (above - below) / 4]
    edges.append(tutored[-1])
    number = np.clip(np.searchsorted(edges, axis.values, side="right") - 1, 0, len(edges) - 2)
    return [
        _Bin("", float(low), float(high), number == which)
        for which, (low, high) in enumerate(pairwise(edges))
    ]


def _places(trials: Trials, name: str) -> dict[str, NDArray[np.bool_]]:
    between = trials.betweenness(name) > 0.5
    return {"near": ~between, "between": between}


def _rate_json(rate: Rate) -> dict[str, Any]:
    return rate.as_json() | {"trials": rate.trials}
