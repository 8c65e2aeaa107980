"""Whether an episode fits a run: what is checked before it is stored, counted or learned from.

The codec has checked each field by then. This checks what only a run's task can tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from proto.body import ACTION_VALUES
from proto.episode import LARGEST_DEG, Floats
from proto.errors import UserError
from proto.messages import EpisodeOutcome
from proto.situations import DrawnTask, variables_of
from proto.suites import Conditions
from proto.variables import Situation, check_situation

_ROUNDING: Final = 1e-3
"""Actions are float32."""
_LOWEST: Final = np.array([value.minimum for value in ACTION_VALUES])
_HIGHEST: Final = np.array([value.maximum for value in ACTION_VALUES])


class PlayedTask(DrawnTask, Protocol):
    """What must be known of a task to tell whether an episode is one of it."""

    @property
    def phases(self) -> NDArray[np.uint8]:
        """Index (T,) of the phase of each control step."""

    def tutored(self) -> Sequence[Situation]:
        """Return the tutored situations, always in the same order."""


class Played(Protocol):
    """What is checked of an episode: an `Episode`, or the summary of a recorded one."""

    @property
    def situation(self) -> Situation:
        """The values of the task's variables."""

    @property
    def conditions(self) -> Conditions | None:
        """The conditions of the suite that it belongs to; None for those of `unlearned`."""

    @property
    def control_period_s(self) -> float:
        """Time from one control step to the next (s)."""

    @property
    def phases(self) -> NDArray[np.uint8]:
        """(T,) the phase of each step."""

    @property
    def actions(self) -> Floats:
        """(T, 11) the commanded actions."""

    @property
    def targets(self) -> Floats:
        """(T, 11) the actions to learn."""


def misfit(episode: Played, task: PlayedTask, control_period_s: float) -> str:
    """Return why an episode is none of a task; empty if it is one.

    Args:
        episode: an episode from a message or a file.
        task: the task of which it must be.
        control_period_s: time of a control step in the run (s).
    """
    return (
        _situation_misfit(episode, task)
        or _shape_misfit(episode, task, control_period_s)
        or _values_misfit(episode)
    )


def outcome_misfit(played: EpisodeOutcome, task: PlayedTask, control_period_s: float) -> str:
    """Return why the outcome is of no episode of a task; empty if it is of one. As `misfit`."""
    return (
        _situation_misfit(played, task)
        or _period_misfit(played.control_period_s, control_period_s)
        or _steps_misfit(played.steps, task)
    )


def _period_misfit(period_s: float, control_period_s: float) -> str:
    if math.isclose(period_s, control_period_s, rel_tol=1e-6):
        return ""
    return f"its control steps take {period_s} s, not {control_period_s} s"


def _steps_misfit(steps: int, task: PlayedTask) -> str:
    if steps == len(task.phases):
        return ""
    return f"it has {steps} steps; an episode of {task.name} has {len(task.phases)}"


def _shape_misfit(episode: Played, task: PlayedTask, control_period_s: float) -> str:
    problem = _period_misfit(episode.control_period_s, control_period_s) or _steps_misfit(
        len(episode.phases), task
    )
    if problem:
        return problem
    if not np.array_equal(episode.phases, task.phases):  # older files name the phases otherwise
        return f"its phases are not those of {task.name}"
    return ""


def _values_misfit(episode: Played) -> str:
    for name, values in (("actions", episode.actions), ("targets", episode.targets)):
        if not np.isfinite(values).all() or float(np.abs(values).max()) > LARGEST_DEG:
            return f"its {name} are not all numbers of at most {LARGEST_DEG:g} in magnitude"
    actions = episode.actions
    if (actions < _LOWEST - _ROUNDING).any() or (actions > _HIGHEST + _ROUNDING).any():
        return "its actions are not within what the robot accepts"
    return ""


def _situation_misfit(episode: Played | EpisodeOutcome, task: PlayedTask) -> str:
    try:
        check_situation(episode.situation, variables_of(task, episode.conditions), task.name)
    except UserError as error:
        return str(error)
    return ""


def same_situation(one: Situation, other: Situation) -> bool:
    """Whether two situations have the same values, up to rounding on another machine."""
    return one.keys() == other.keys() and all(
        value == other[name]
        if isinstance(value, str) or isinstance(other[name], str)
        else math.isclose(value, float(other[name]), rel_tol=1e-9, abs_tol=1e-12)
        for name, value in one.items()
    )
