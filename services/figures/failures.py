"""Where a policy fails: at tutored values of the situation, or in between?

A network that snaps to the values that it was taught acts as if the nearest of them were the true
one. Then it errs most midway between two of them, and its errors follow a saw-tooth.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from actors.tasks.contract import Task
from actors.tasks.experiment1 import task as experiment1
from proto.episode import Outcome, Reason
from proto.errors import UserError
from services.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    READING_COLOURS,
    RED,
    label,
    look,
    percent,
    words_and_unit,
)
from services.terminal.rates import rate_text
from services.trials.success import Rate
from services.trials.trial_log import CountedTrial

Array = NDArray[np.float64]

YAW: Final = "object_yaw_deg"
POSITION: Final = "object_y_m"
READINGS: Final = ("strict", "precise")
REASONS: Final[Mapping[Reason, tuple[str, str, str]]] = {
    Reason.NONE: ("precise", GREEN, "o"),
    Reason.IMPRECISE: ("strict, not precise", ORANGE, "o"),
    Reason.NOT_LIFTED: ("not lifted", BLUE, "^"),
    Reason.NEVER_CLOSED: ("never closed", BLACK, "x"),
    Reason.MOVED_OBJECT: ("moved the object", RED, "s"),
    Reason.TOUCHED_OBSTACLE: ("touched the obstacle", PINK, "D"),
}
"""What to call each reason, its colour and its marker."""
ERRORS: Final[Mapping[str, tuple[str, float]]] = {
    "yaw_error_deg": ("yaw error\n(degrees)", experiment1.YAW_ERROR_DEG),
    "along_mm": ("offset along\n(mm)", experiment1.ALONG_MM),
    "across_mm": ("offset across\n(mm)", experiment1.ACROSS_MM),
    "position_mm": ("offset in Y\n(mm)", experiment1.ALONG_MM),
}
"""The errors at the grasp: what to call each, and about how large it may be."""
SHOWN: Final = 2.5
"""Errors are shown up to so many times what they may be; beyond, the hand was elsewhere."""
SAW_TEETH: Final[Mapping[str, tuple[str, float]]] = {
    YAW: ("yaw_error_deg", 1.0),
    POSITION: ("position_mm", 1e3),
}
"""The error that shows snapping to each value, and its unit in that of the value."""
_Z95: Final = 1.96
_EXPLANATION: Final = (
    "Dotted: tutored values. Errors are those of trials in which the object was still in its place"
    " when the hand closed;\nlarger ones stand at the edge; grey: about what a precise grasp may"
    " have; black: a policy that takes the nearest tutored value for the true one."
)


@dataclass(frozen=True)
class Trials:
    """N trials of one policy, and what it was tutored.

    Attributes:
        values: (N,) of each value of the situation by name.
        tutored: the values that were tutored, in order, by name.
        outcomes: how each trial ended.
    """

    values: Mapping[str, Array]
    tutored: Mapping[str, Array]
    outcomes: Sequence[Outcome]

    @classmethod
    def of(cls, trials: Sequence[CountedTrial], task: Task) -> Trials:
        """Trials of a task.

        Raises:
            UserError: there are none, or they are of another task.
        """
        if not trials:
            raise UserError(
                "there is no trial to draw; `vmdnn evaluate --outcomes FILE` plays some"
            )
        for trial in trials:
            task.check(trial.situation)
        grid = task.tutored()
        tutored = {name: np.unique([case[name] for case in grid]) for name in grid[0]}
        return cls(
            values={
                name: np.array([trial.situation[name] for trial in trials])
                for name, values in tutored.items()
                if len(values) > 1
            },
            tutored={name: values for name, values in tutored.items() if len(values) > 1},
            outcomes=[trial.outcome for trial in trials],
        )

    def measured(self, name: str) -> Array:
        """(N,) of a number or a reading of the outcomes."""
        return np.array([getattr(outcome, name) for outcome in self.outcomes], dtype=np.float64)

    def betweenness(self, name: str) -> Array:
        """(N,) how far each value is from a tutored one: 0 at it, 1 midway between two."""
        tutored, values = self.tutored[name], self.values[name]
        upper = np.clip(np.searchsorted(tutored, values), 1, len(tutored) - 1)
        below, above = tutored[upper - 1], tutored[upper]
        return 2 * np.minimum(np.abs(values - below), np.abs(above - values)) / (above - below)

    def to_nearest(self, name: str) -> Array:
        """(N,) from each value to the nearest tutored one."""
        tutored, values = self.tutored[name], self.values[name]
        nearest = tutored[np.abs(values[:, None] - tutored).argmin(axis=1)]
        result: Array = nearest - values
        return result

    def rate(self, reading: str, chosen: NDArray[np.bool_]) -> Rate:
        """Success in one reading, over the chosen of the trials."""
        return Rate(int(self.measured(reading)[chosen].sum()), int(chosen.sum()))

    def approached(self) -> NDArray[np.bool_]:
        """(N,) whether the hand closed while the object was still in its place."""
        return (
            (self.measured("closed_at") >= 0)
            & (self.measured("moved_mm") <= experiment1.MOVED_MM)
            & (self.measured("turned_deg") <= experiment1.TURNED_DEG)
        )

    def reached(self) -> NDArray[np.bool_]:
        """(N,) whether in addition the hand was about where the object was."""
        reached = self.approached()
        for name, (_, allowed) in ERRORS.items():
            reached &= np.abs(self.error(name)) < SHOWN * allowed
        return reached

    def error(self, name: str) -> Array:
        """(N,) one of ERRORS."""
        if name != "position_mm":
            return self.measured(name)
        turn = np.deg2rad(self.values[YAW])
        along, across = self.measured("along_mm"), self.measured("across_mm")
        offset: Array = along * np.cos(turn) - across * np.sin(turn)
        return offset


@dataclass(frozen=True)
class Snapping:
    """How much of the way to the nearest tutored value the hand is drawn.

    Attributes:
        share: 0 for a policy that interpolates, 1 for one that acts as if the nearest were true.
        half_width: of its 95 % interval.
        trials: from how many trials.
    """

    share: float
    half_width: float
    trials: int


def snapping(trials: Trials, name: str) -> Snapping | None:
    """Snapping to tutored values of SAW_TEETH; None for others, or with too few trials.

    Least squares of the error on the distance to the nearest tutored value; a constant error and
    one that grows with the value, such as a pull to the middle of the range, are told apart.
    """
    if name not in SAW_TEETH:
        return None
    error_name, unit = SAW_TEETH[name]
    error = trials.error(error_name) / unit
    chosen = trials.reached()
    columns = (np.ones(len(error)), trials.values[name], trials.to_nearest(name))
    causes = np.stack(columns, axis=1)[chosen]
    count, unknowns = causes.shape
    if count < 2 * unknowns or np.linalg.matrix_rank(causes) < unknowns:
        return None
    effects, *_ = np.linalg.lstsq(causes, error[chosen], rcond=None)
    variance = np.square(error[chosen] - causes @ effects).sum() / (count - unknowns)
    deviation = np.sqrt(variance * np.linalg.inv(causes.T @ causes)[-1, -1])
    return Snapping(float(effects[-1]), float(_Z95 * deviation), count)


def numbers(trials: Trials) -> dict[str, Any]:
    """What the figure shows, for `json.dumps`."""
    found = {name: snapping(trials, name) for name in trials.values}
    return {
        "trials": len(trials.outcomes),
        "near_and_between": {
            name: {
                place: {reading: _rate_json(trials.rate(reading, chosen)) for reading in READINGS}
                for place, chosen in _places(trials, name).items()
            }
            for name in trials.values
        },
        "by_value": {
            name: [
                {
                    "from": low,
                    "to": high,
                    **{reading: _rate_json(trials.rate(reading, chosen)) for reading in READINGS},
                }
                for low, high, chosen in _bins(trials, name)
            ]
            for name in trials.values
        },
        "snapping": {name: vars(each) for name, each in found.items() if each is not None},
    }


def table(trials: Trials) -> Table:
    """Success near tutored values and between them, and how far the hand snaps to them."""
    result = Table(
        caption="near: within a quarter of the spacing of a tutored value; snapping: 0 for none,"
        " 1 for acting as if the nearest tutored value were the true one"
    )
    headings = (f"{reading} {place} %" for reading in READINGS for place in ("near", "between"))
    for heading in ("value", *headings, "snapping"):
        result.add_column(heading, justify="left" if heading == "value" else "right")
    for name in trials.values:
        places = _places(trials, name)
        cells = [
            rate_text(trials.rate(reading, chosen), digits=0)
            for reading in READINGS
            for chosen in places.values()
        ]
        found = snapping(trials, name)
        drawn = "" if found is None else f"{found.share:.2f} ± {found.half_width:.2f}"
        result.add_row(words_and_unit(name)[0], *cells, drawn)
    return result


def draw(trials: Trials, title: str) -> Figure:
    """Where trials failed, how often by each value, and the errors at the grasp."""
    with look():
        names = list(trials.values)
        figure = Figure(figsize=(9.0, 12.0), layout="constrained")
        figure.suptitle(title, fontsize=10)
        rows: Any = figure.subfigures(2, 1, height_ratios=[1.15, 4.6])
        _draw_maps(rows[0], trials)
        axes = rows[1].subplots(
            1 + len(ERRORS), len(names), sharex="col", sharey="row", squeeze=False
        )
        for column, name in zip(axes.T, names, strict=True):
            _draw_rates(column[0], trials, name)
            for each, error in zip(column[1:], ERRORS, strict=True):
                _draw_errors(each, trials, name, error)
            column[-1].set_xlabel(label(name))
        axes[0, 0].set_ylabel("success (%)")
        for row, (title_of_error, _) in zip(axes[1:], ERRORS.values(), strict=True):
            row[0].set_ylabel(title_of_error)
        axes[0, 0].legend(loc="lower left", ncols=2)
        rows[1].supxlabel(_EXPLANATION, fontsize=8)
        rows[1].align_ylabels(axes[:, 0])
        return figure


def _draw_maps(figure: Any, trials: Trials) -> None:
    pairs = list(combinations(trials.values, 2)) or [(next(iter(trials.values)),) * 2]
    axes = figure.subplots(1, len(pairs), squeeze=False)[0]
    for each, (across, up) in zip(axes, pairs, strict=True):
        for reason, (words, colour, marker) in REASONS.items():
            chosen = np.array([outcome.reason is reason for outcome in trials.outcomes])
            each.scatter(
                trials.values[across][chosen],
                trials.values[up][chosen],
                s=7 if reason is Reason.NONE else 14,
                color=colour,
                marker=marker,
                linewidths=0.8 if marker == "x" else 0,
                alpha=0.35 if reason is Reason.NONE else 0.9,
                label=f"{words} ({chosen.sum()})" if chosen.any() else None,
            )
        each.set_xlabel(label(across))
        each.set_ylabel(label(up))
        _mark_tutored(each.axvline, trials.tutored[across])
        _mark_tutored(each.axhline, trials.tutored[up])
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), columnspacing=1.2)


def _draw_rates(axes: Axes, trials: Trials, name: str) -> None:
    bins = _bins(trials, name)
    centres = np.array([(low + high) / 2 for low, high, _ in bins])
    nudge = 0.02 * float(np.diff(trials.tutored[name]).min())
    for side, reading in enumerate(READINGS):
        middle, reach = percent(trials.rate(reading, chosen) for _, _, chosen in bins)
        axes.errorbar(
            centres + (2 * side - 1) * nudge,
            middle,
            yerr=reach,
            color=READING_COLOURS[reading],
            marker="o",
            markersize=3,
            linewidth=1.0,
            elinewidth=0.8,
            label=reading,
        )
    axes.set_ylim(0, 102)
    _mark_tutored(axes.axvline, trials.tutored[name])


def _draw_errors(axes: Axes, trials: Trials, name: str, error: str) -> None:
    _, allowed = ERRORS[error]
    limit = SHOWN * allowed
    chosen, values = trials.approached(), trials.values[name]
    errors = np.clip(trials.error(error), -0.97 * limit, 0.97 * limit)  # none is left out
    axes.axhspan(-allowed, allowed, color=GREY, alpha=0.15, linewidth=0)
    axes.axhline(0, color=GREY, linewidth=0.5)
    for reason, (_, colour, _) in REASONS.items():
        those = chosen & np.array([outcome.reason is reason for outcome in trials.outcomes])
        axes.scatter(values[those], errors[those], s=4, color=colour, alpha=0.5, linewidths=0)
    tooth, unit = SAW_TEETH.get(name, ("", 1.0))
    if error == tooth:
        taught, snapped = _saw_tooth(trials.tutored[name])
        axes.plot(taught, unit * snapped, color=BLACK, linewidth=0.7)
    axes.set_ylim(-limit, limit)
    axes.set_yticks([-2 * allowed, -allowed, 0, allowed, 2 * allowed])
    _mark_tutored(axes.axvline, trials.tutored[name])


def _saw_tooth(tutored: Array) -> tuple[Array, Array]:
    """Values, and the errors at them of a policy that takes each for the nearest tutored one."""
    values, errors = [], []
    for below, above in pairwise(tutored):
        middle = (below + above) / 2
        values += [below, middle, middle, above]
        errors += [0.0, below - middle, above - middle, 0.0]
    return np.array(values), np.array(errors)


def _mark_tutored(line: Any, tutored: Iterable[float]) -> None:
    for value in tutored:
        line(value, color=GREY, linewidth=0.5, linestyle=(0, (2, 2)), zorder=0)


def _bins(trials: Trials, name: str) -> list[tuple[float, float, NDArray[np.bool_]]]:
    """Ranges of a value in order, around tutored values and between them by turns."""
    tutored, values = trials.tutored[name], trials.values[name]
    edges = [tutored[0]]
    for below, above in pairwise(tutored):
        edges += [below + (above - below) / 4, below + 3 * (above - below) / 4]
    edges.append(tutored[-1])
    number = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    return [
        (float(low), float(high), number == which)
        for which, (low, high) in enumerate(pairwise(edges))
    ]


def _places(trials: Trials, name: str) -> dict[str, NDArray[np.bool_]]:
    between = trials.betweenness(name) > 0.5
    return {"near": ~between, "between": between}


def _rate_json(rate: Rate) -> dict[str, Any]:
    return rate.as_json() | {"trials": rate.trials}
