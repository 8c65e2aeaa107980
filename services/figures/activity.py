"""Figure of the network's activity during episodes (paper, figure 4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from actors.policies.contract import StatefulPolicy
from learner.network.subnets import ACTIVATION_GAIN
from proto.body import ACTION_NAMES, ARM, FOCUS, GRASP, NECK
from proto.episode import Episode, Floats, States
from proto.errors import UserError
from proto.variables import Value
from services.figures.style import BLACK, figure_style, words_and_unit

SUBNETS: Final[Mapping[str, str]] = {"mstnn_fast": "V_F", "pfc": "PFC", "mtrnn_fast": "M_F"}
"""The subnets that the figure shows, with the paper's symbol of each."""
UNITS_SHOWN: Final = 50
"""Largest number of units shown of a subnet: those that vary most."""
OUTPUTS: Final[Mapping[str, slice]] = {
    "neck\n(degrees)": NECK,
    "arm\n(degrees)": ARM,
    "grasp\nlevel": slice(GRASP, GRASP + 1),
    "focus\nlevel": slice(FOCUS, FOCUS + 1),
}
_SAME_OUTPUTS: Final = 1e-3
"""Largest difference by rounding between the outputs of a network that sees the same pictures."""
_RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "grasp\nlevel": (0.5, 10.5),
    "focus\nlevel": (0.0, 21.0),
}


@dataclass(frozen=True)
class Activity:
    """An episode of T steps with the activity of the network.

    Attributes:
        episode: the episode.
        states: activity (T, units) of each subnet by name.
    """

    episode: Episode
    states: States

    @property
    def phase_starts(self) -> NDArray[np.int64]:
        """First step of each phase, followed by T."""
        phases = self.episode.phases
        starts = np.flatnonzero(np.diff(phases)) + 1
        return np.concatenate([[0], starts, [len(phases)]])


def activity_of(episode: Episode, policy: StatefulPolicy | None) -> Activity:
    """Return an episode with its states.

    Args:
        episode: the episode.
        policy: the policy that played it. It sees the pictures again to compute the states. If
            None, the recorded states are used.

    Raises:
        UserError: there is neither a policy nor a recorded state, or another policy played the
            episode.
    """
    if episode.states is not None and policy is None:
        states = episode.states
    elif policy is not None:
        _check_same_policy(episode, policy)
        states = policy.states(episode.images)
    else:
        raise UserError(
            f"rollout {episode.id} of policy {episode.policy!r} has no states; record it with"
            " `vmdnn evaluate --states`, or name the checkpoint that played it with --policy"
        )
    missing = SUBNETS.keys() - states.keys()
    if missing:
        raise UserError(f"rollout {episode.id} has no states of {', '.join(sorted(missing))}")
    return Activity(episode, states)


def shown_units(activities: Sequence[Activity]) -> dict[str, NDArray[np.int64]]:
    """Choose the units to show of each subnet, the same for all episodes; their indices."""
    shown = {}
    for name in SUBNETS:
        states = np.concatenate([activity.states[name] for activity in activities])
        most_varying = np.argsort(states.std(axis=0))[-UNITS_SHOWN:]
        shown[name] = np.sort(most_varying)
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
    starts = one.phase_starts
    if not np.array_equal(starts, other.phase_starts):
        raise UserError("the two rollouts have different phases; choose two of the same task")
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
    for name, symbol in SUBNETS.items():
        change = np.mean([each[name] for each in changes])
        result.add_row(symbol, f"{change:.3f}", *(f"{value:.2f}" for value in apart[name]))
    return result


def draw(activities: Sequence[Activity]) -> Figure:
    """Draw one column for each episode: units of the subnets over time, outputs and phases."""
    with figure_style():
        shown = shown_units(activities)
        figure = Figure(figsize=(1.4 + 3.2 * len(activities), 7.4), layout="constrained")
        axes = figure.subplots(
            len(SUBNETS) + len(OUTPUTS),
            len(activities) + 1,
            sharex="col",
            sharey="row",
            squeeze=False,
            height_ratios=[2.2, 1.4, 2.2, 1, 1.7, 0.8, 0.8],
            width_ratios=[*(1.0 for _ in activities), 0.3],
        )
        columns, margin = axes.T[:-1], axes.T[-1]
        for column, activity, title in zip(columns, activities, _titles(activities), strict=True):
            _draw_column(column, activity, shown)
            column[0].set_title(title)
        for first, name in zip(columns[0], [*SUBNETS, *OUTPUTS], strict=True):
            first.set_ylabel(_row_label(name, activities[0], shown))
        figure.align_ylabels(columns[0])
        _add_legends(figure, columns[-1], margin)
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
        )


def _row_label(name: str, activity: Activity, shown: Mapping[str, NDArray[np.int64]]) -> str:
    if name not in SUBNETS:
        return name
    units = activity.states[name].shape[1]
    symbol = SUBNETS[name]
    subscripted = f"${symbol[0]}_{symbol[2]}$" if "_" in symbol else symbol
    if units == len(shown[name]):
        return f"{subscripted}\n{units} units"
    return f"{subscripted}\n{len(shown[name])} of {units} units"


def _titles(activities: Sequence[Activity]) -> list[str]:
    """Return a title for each episode: the variables that differ; all for a single episode."""
    situations = [activity.episode.situation for activity in activities]
    first = situations[0]
    shown = [
        name for name in first if len({situation.get(name) for situation in situations}) > 1
    ] or list(first)
    return [
        ", ".join(_value_text(name, situation[name]) for name in shown) for situation in situations
    ]


def _value_text(name: str, value: Value) -> str:
    words, unit = words_and_unit(name)
    if isinstance(value, str):
        return f"{words} {value}"
    return f"{words} {value:g}°" if unit == "degrees" else f"{words} {value:g} {unit}".rstrip()


def _check_same_policy(episode: Episode, policy: StatefulPolicy) -> None:
    if episode.outputs is None:
        raise UserError(f"rollout {episode.id} was not played by a network, so it has no states")
    policy.begin(episode.situation, episode.seed)
    again = np.stack([_outputs(policy, image) for image in episode.images])
    difference = (
        np.abs(again - episode.outputs).max() if again.shape == episode.outputs.shape else np.inf
    )
    if difference > _SAME_OUTPUTS:
        raise UserError(
            f"rollout {episode.id} was played by {episode.policy!r} version"
            f" {episode.policy_version}, not by this policy, whose outputs differ"
        )


def _outputs(policy: StatefulPolicy, image: NDArray[np.uint8]) -> Floats:
    policy.step(image)
    if policy.outputs is None:
        raise UserError(f"policy {policy.name!r} has no outputs to compare")
    return policy.outputs.copy()


def _numbers_of(activity: Activity, shown: Mapping[str, NDArray[np.int64]]) -> dict[str, Any]:
    episode = activity.episode
    return {
        "id": episode.id,
        "policy": episode.policy,
        "policy_version": episode.policy_version,
        "situation": dict(episode.situation),
        "reason": episode.outcome.reason,
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
