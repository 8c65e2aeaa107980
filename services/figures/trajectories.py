"""Figure of the trajectories of a subnet's states in several rollouts (paper, figure 7)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, cycle
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from proto.errors import UserError
from services.figures.components import Components
from services.figures.rollouts import (
    SYMBOLS,
    Activity,
    common_phase_starts,
    differing_variables,
    distinctions,
    numbered_phases,
    wrapped,
)
from services.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PINK,
    RED,
    SKY,
    YELLOW,
    figure_style,
    words_and_unit,
)

Array = NDArray[np.float64]

COLOURS: Final = (RED, BLUE, GREEN, SKY, ORANGE, PINK, BLACK, YELLOW)
"""Colours of the rollouts in their order; repeated if there are more."""
CAPTION_WIDTH: Final = 120
LEGEND_WIDTH: Final = 60
_CLOSE: Final = 0.03
"""A number is left out if it is closer to another one than this share of the plot's extent."""


@dataclass(frozen=True)
class Trajectories:
    """The states of one subnet in several rollouts with the same phases.

    Attributes:
        activities: the rollouts.
        subnet: name of the subnet.
        states: (T, units) its states in each rollout.
        phase_starts: first step of each phase, followed by T.
        components: the two main components of the states of all rollouts.
        units: the two units that are shown.
    """

    activities: Sequence[Activity]
    subnet: str
    states: Sequence[Array]
    phase_starts: NDArray[np.int64]
    components: Components
    units: tuple[int, int]

    @classmethod
    def of(
        cls, activities: Sequence[Activity], subnet: str, units: tuple[int, int] | None = None
    ) -> Trajectories:
        """Collect the states of a subnet.

        Args:
            activities: the rollouts.
            subnet: name of the subnet.
            units: the units to show; without it, the two whose states vary most, in this order.

        Raises:
            UserError: the phases of the rollouts differ, or there is no such unit.
        """
        starts = common_phase_starts(activities)
        states = [activity.states[subnet].astype(np.float64) for activity in activities]
        together = np.concatenate(states)
        count = together.shape[1]
        if count < 2:
            raise UserError(f"{subnet} has {count} unit; choose a subnet with more units")
        if units is None:
            first, second = np.argsort(-together.var(axis=0), kind="stable")[:2].tolist()
            units = (first, second)
        if units[0] == units[1] or max(units) >= count:
            raise UserError(
                f"--units {units[0]} {units[1]}: name two different units of {subnet}, which has"
                f" the units 0 to {count - 1}"
            )
        return cls(activities, subnet, states, starts, Components.of(together), units)

    @property
    def labels(self) -> list[str]:
        """What distinguishes each rollout from the others."""
        return [", ".join(words) for words in distinctions([a.episode for a in self.activities])]

    def in_components(self) -> list[Array]:
        """Return the states (T, 2) of each rollout along the two main components."""
        return [self.components.project(each) for each in self.states]

    def in_units(self) -> list[Array]:
        """Return the states (T, 2) of the two units in each rollout."""
        return [each[:, list(self.units)] for each in self.states]

    def distances(self) -> list[Distance]:
        """Return the distance of each pair of rollouts."""
        return [
            self._distance(one, other) for one, other in combinations(range(len(self.states)), 2)
        ]

    def _distance(self, one: int, other: int) -> Distance:
        apart = np.linalg.norm(self.states[one] - self.states[other], axis=1)
        situations = [self.activities[number].episode.situation for number in (one, other)]
        return Distance(
            rollouts=(one, other),
            variables=tuple(differing_variables(situations)),
            by_phase=[float(part.mean()) for part in np.split(apart, self.phase_starts[1:-1])],
        )


@dataclass(frozen=True)
class Distance:
    """Distance of two trajectories.

    Attributes:
        rollouts: numbers of the rollouts.
        variables: variables of the situation in which they differ.
        by_phase: mean Euclidean distance of the states in each phase, over all units.
    """

    rollouts: tuple[int, int]
    variables: tuple[str, ...]
    by_phase: Sequence[float]


def numbers(trajectories: Trajectories) -> dict[str, Any]:
    """Return the numbers of the figure, for `json.dumps`."""
    in_components, in_units = trajectories.in_components(), trajectories.in_units()
    return {
        "subnet": trajectories.subnet,
        "units": list(trajectories.units),
        "explained_variance": trajectories.components.explained.tolist(),
        "phases": trajectories.activities[0].phase_names,
        "phase_starts": trajectories.phase_starts[:-1].tolist(),
        "rollouts": [
            {
                "id": activity.episode.id,
                "policy": activity.episode.policy,
                "policy_version": activity.episode.policy_version,
                "situation": dict(activity.episode.situation),
                "label": label,
                "components": np.round(in_components[number], 4).tolist(),
                "units": np.round(in_units[number], 4).tolist(),
            }
            for number, (activity, label) in enumerate(
                zip(trajectories.activities, trajectories.labels, strict=True)
            )
        ],
        "distances": [
            {
                "rollouts": list(each.rollouts),
                "differ_in": list(each.variables),
                "mean_by_phase": list(each.by_phase),
            }
            for each in trajectories.distances()
        ],
    }


def table(trajectories: Trajectories) -> Table:
    """Return a table of the mean distance of rollouts by phase and by what they differ in."""
    result = Table(caption="mean Euclidean distance of two rollouts by subtask")
    result.add_column("rollouts that differ in")
    result.add_column("pairs", justify="right")
    for phase in range(1, len(trajectories.phase_starts)):
        result.add_column(f"({phase})", justify="right", no_wrap=True)
    for variables, distances in _by_variables(trajectories.distances()).items():
        words = ", ".join(words_and_unit(name)[0] for name in variables)
        means = np.mean([each.by_phase for each in distances], axis=0)
        result.add_row(
            words or "no variable", str(len(distances)), *(f"{mean:.2f}" for mean in means)
        )
    return result


def draw(trajectories: Trajectories) -> Figure:
    """Draw the trajectories in the plane of the main components and in that of two units."""
    with figure_style():
        figure = Figure(figsize=(8.4, 4.6), layout="constrained")
        components, units = figure.subplots(1, 2)
        symbol = SYMBOLS[trajectories.subnet]
        _draw_plane(components, trajectories, trajectories.in_components())
        components.set_title(f"{symbol}: main components")
        shares = 100 * trajectories.components.explained
        components.set_xlabel(f"component 1 ({shares[0]:.0f} % of the variance)")
        components.set_ylabel(f"component 2 ({shares[1]:.0f} % of the variance)")
        _draw_plane(units, trajectories, trajectories.in_units())
        units.set_title(f"{symbol}: two units")
        units.set_xlabel(f"activity of unit {trajectories.units[0]}")
        units.set_ylabel(f"activity of unit {trajectories.units[1]}")
        handles, labels = components.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=2)
        phases = wrapped(numbered_phases(trajectories.activities[0]), CAPTION_WIDTH)
        figure.supxlabel(f"numbers: where a subtask begins. {phases}", fontsize=7.5)
        return figure


def _draw_plane(axes: Axes, trajectories: Trajectories, points: Sequence[Array]) -> None:
    """Draw the points (T, 2) of each rollout as a line with the numbers of the subtasks."""
    starts = trajectories.phase_starts[:-1]
    extent = np.ptp(np.concatenate(points), axis=0)
    extent[extent == 0] = 1.0
    numbered: list[Array] = []
    words = distinctions([activity.episode for activity in trajectories.activities])
    for each, colour, label in zip(points, cycle(COLOURS), words, strict=False):
        axes.plot(*each.T, color=colour, linewidth=1.0, label=wrapped(label, LEGEND_WIDTH))
        axes.scatter(each[starts, 0], each[starts, 1], s=8, color=colour, zorder=3)
        for phase, point in enumerate(each[starts], 1):
            if not _is_close(point, numbered, extent):
                numbered.append(point)
                axes.annotate(
                    str(phase),
                    (float(point[0]), float(point[1])),
                    (3, 3),
                    textcoords="offset points",
                    color=colour,
                    fontsize=7,
                )


def _is_close(point: Array, others: Sequence[Array], extent: Array) -> bool:
    """Return whether a point (2,) lies close to one of some others."""
    return any(np.linalg.norm((point - other) / extent) < _CLOSE for other in others)


def _by_variables(distances: Sequence[Distance]) -> Mapping[tuple[str, ...], list[Distance]]:
    """Group distances by the variables in which the rollouts differ, fewest variables first."""
    groups: dict[tuple[str, ...], list[Distance]] = defaultdict(list)
    for each in sorted(distances, key=lambda each: len(each.variables)):
        groups[each.variables].append(each)
    return groups
