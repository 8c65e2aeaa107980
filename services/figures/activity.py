"""Figure of the network's activity during episodes (paper, figure 4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from learner.network.subnets import ACTIVATION_GAIN
from proto.body import ACTION_NAMES, ARM, FOCUS, GRASP, NECK
from services.figures.rollouts import (
    SYMBOLS,
    Activity,
    common_phase_starts,
    distinctions,
    numbered_phases,
    wrapped,
)
from services.figures.style import BLACK, figure_style

SUBNETS: Final = ("mstnn_fast", "pfc", "mtrnn_slow", "mtrnn_fast")
"""The subnets that the figure shows."""
UNITS_SHOWN: Final = 51
"""Largest number of units shown of a subnet: those that vary most."""
GROUPS: Final = {"mstnn_fast": 3}
"""Groups of equal size from which the shown units of a subnet are taken. The units of V_F are in
the order of its maps, of which the paper's network has three."""
OUTPUTS: Final[Mapping[str, slice]] = {
    "neck\n(degrees)": NECK,
    "arm\n(degrees)": ARM,
    "grasp\nlevel": slice(GRASP, GRASP + 1),
    "focus\nlevel": slice(FOCUS, FOCUS + 1),
}
TITLE_WIDTH: Final = 44
"""Largest number of characters in a line of a column's title."""
CAPTION_WIDTH: Final = 60
"""Largest number of characters in a line of the caption, for each column."""
_RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "grasp\nlevel": (0.5, 10.5),
    "focus\nlevel": (0.0, 21.0),
}


def shown_units(activities: Sequence[Activity]) -> dict[str, NDArray[np.int64]]:
    """Choose the units to show of each subnet, the same for all episodes; their indices."""
    shown = {}
    for name in SUBNETS:
        states = np.concatenate([activity.states[name] for activity in activities])
        deviations = states.std(axis=0)
        groups = np.array_split(np.arange(len(deviations)), GROUPS.get(name, 1))
        most = UNITS_SHOWN // len(groups)
        chosen = [group[np.argsort(deviations[group])[-most:]] for group in groups]
        shown[name] = np.sort(np.concatenate(chosen))
    return shown


def change_per_step(activity: Activity) -> dict[str, float]:
    """Return for each subnet the mean magnitude of a unit's change from one step to the next."""
    return {name: float(np.abs(np.diff(activity.states[name], axis=0)).mean()) for name in SUBNETS}


def difference_by_phase(one: Activity, other: Activity) -> dict[str, list[float]]:
    """Return for each subnet the difference between two episodes in each phase.

    The difference is the root mean square over units and steps.

    Raises:
        UserError: the phases of the episodes differ.
    """
    starts = common_phase_starts([one, other])
    return {
        name: [
            float(np.sqrt(np.square(part).mean()))
            for part in np.split(one.states[name] - other.states[name], starts[1:-1])
        ]
        for name in SUBNETS
    }


def numbers(activities: Sequence[Activity]) -> dict[str, Any]:
    """Return the numbers of the figure, for `json.dumps`."""
    shown = shown_units(activities)
    result: dict[str, Any] = {
        "units": {name: units.tolist() for name, units in shown.items()},
        "rollouts": [_numbers_of(activity, shown) for activity in activities],
    }
    if len(activities) == 2:
        result["difference_by_phase"] = difference_by_phase(*activities)
    return result


def table(activities: Sequence[Activity]) -> Table:
    """Return a table of each subnet's change per step and the difference between two episodes."""
    result = Table(caption="change of a unit in a step; root mean square difference by subtask")
    phases = len(activities[0].phase_starts) - 1 if len(activities) == 2 else 0
    for heading in ("subnet", "change", *(f"({phase})" for phase in range(1, phases + 1))):
        result.add_column(heading, justify="left" if heading == "subnet" else "right", no_wrap=True)
    changes = [change_per_step(activity) for activity in activities]
    apart = difference_by_phase(*activities) if phases else {name: [] for name in SUBNETS}
    for name in SUBNETS:
        change = np.mean([each[name] for each in changes])
        result.add_row(
            SYMBOLS[name].strip("$"), f"{change:.3f}", *(f"{value:.2f}" for value in apart[name])
        )
    return result


def draw(activities: Sequence[Activity]) -> Figure:
    """Draw one column for each episode: units of the subnets over time, outputs and phases."""
    with figure_style():
        shown = shown_units(activities)
        figure = Figure(figsize=(1.4 + 3.2 * len(activities), 8.4), layout="constrained")
        axes = figure.subplots(
            len(SUBNETS) + len(OUTPUTS),
            len(activities) + 1,
            sharex="col",
            sharey="row",
            squeeze=False,
            height_ratios=[2.2, 1.4, 1.6, 2.2, 1, 1.7, 0.8, 0.8],
            width_ratios=[*(1.0 for _ in activities), 0.3],
        )
        columns, margin = axes.T[:-1], axes.T[-1]
        titles = distinctions([activity.episode for activity in activities])
        for column, activity, title in zip(columns, activities, titles, strict=True):
            _draw_column(column, activity, shown)
            column[0].set_title(wrapped(title, TITLE_WIDTH))
        for first, name in zip(columns[0], [*SUBNETS, *OUTPUTS], strict=True):
            first.set_ylabel(_row_label(name, activities[0], shown))
        figure.align_ylabels(columns[0])
        _add_legends(figure, columns[-1], margin)
        phases = wrapped(numbered_phases(activities[0]), CAPTION_WIDTH * len(activities))
        figure.supxlabel(f"subtasks: {phases}", fontsize=7.5)
        return figure


def _add_legends(figure: Figure, column: Sequence[Axes], margin: Sequence[Axes]) -> None:
    """Add the colour scale and the legends of a column in the margin beside it."""
    for axes in margin:
        axes.set_axis_off()
    scale = ScalarMappable(Normalize(-ACTIVATION_GAIN, ACTIVATION_GAIN), "RdBu_r")
    figure.colorbar(scale, cax=margin[0].inset_axes((0.0, 0.0, 0.12, 1.0)), label="activity")
    for row in (len(SUBNETS), len(SUBNETS) + 1):
        handles, labels = column[row].get_legend_handles_labels()
        margin[row].legend(
            handles,
            labels,
            loc="center left",
            bbox_to_anchor=(-0.1, 0.5),
            handlelength=1.0,
            borderpad=0.0,
        )


def _draw_column(
    column: Sequence[Axes], activity: Activity, shown: Mapping[str, NDArray[np.int64]]
) -> None:
    steps = activity.episode.steps
    for axes, name in zip(column, SUBNETS, strict=False):
        units = activity.states[name][:, shown[name]].T
        axes.imshow(
            units,
            cmap="RdBu_r",
            vmin=-ACTIVATION_GAIN,
            vmax=ACTIVATION_GAIN,
            aspect="auto",
            interpolation="nearest",
            extent=(0, steps, len(units), 0),
        )
        axes.set_yticks([])
        size = len(units) / GROUPS.get(name, 1)
        for border in range(1, GROUPS.get(name, 1)):
            axes.axhline(border * size, color=BLACK, linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(True)
    for axes, (name, values) in zip(column[len(SUBNETS) :], OUTPUTS.items(), strict=True):
        actions = activity.episode.actions[:, values]
        for value, value_name in zip(actions.T, ACTION_NAMES[values], strict=True):
            axes.plot(
                np.arange(steps) + 0.5, value, label=value_name.removeprefix("r_").replace("_", " ")
            )
        if name in _RANGES:
            axes.set_ylim(*_RANGES[name])
        axes.set_xlim(0, steps)
    _mark_phases(column, activity.phase_starts)


def _mark_phases(column: Sequence[Axes], starts: NDArray[np.int64]) -> None:
    for axes in column:
        for start in starts[1:-1]:
            axes.axvline(start, color=BLACK, linewidth=0.5, linestyle=(0, (2, 2)))
    last = column[-1]
    last.set_xlabel("control step; below, the subtask", labelpad=14)
    for phase, (start, end) in enumerate(pairwise(starts), 1):
        last.annotate(
            f"({phase})",
            ((start + end) / 2, 0),
            (0, -22),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="center",
            fontsize=7,  # the shortest subtask of Experiment II is a twentieth of the episode
        )


def _row_label(name: str, activity: Activity, shown: Mapping[str, NDArray[np.int64]]) -> str:
    if name not in SUBNETS:
        return name
    units = activity.states[name].shape[1]
    if units == len(shown[name]):
        return f"{SYMBOLS[name]}\n{units} units"
    maps = f"\n{GROUPS[name]} maps" if name in GROUPS else ""
    return f"{SYMBOLS[name]}\n{len(shown[name])} of {units} units{maps}"


def _numbers_of(activity: Activity, shown: Mapping[str, NDArray[np.int64]]) -> dict[str, Any]:
    episode = activity.episode
    return {
        "id": episode.id,
        "policy": episode.policy,
        "policy_version": episode.policy_version,
        "situation": dict(episode.situation),
        "reason": episode.outcome.reason,
        "phases": activity.phase_names,
        "phase_starts": activity.phase_starts[:-1].tolist(),
        "change_per_step": change_per_step(activity),
        "activity": {
            name: np.round(activity.states[name][:, units], 4).tolist()
            for name, units in shown.items()
        },
        "actions": {
            name: np.round(values, 3).tolist()
            for name, values in zip(ACTION_NAMES, episode.actions.T, strict=True)
        },
    }
