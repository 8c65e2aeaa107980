"""Which situation a seed stands for, also where a suite stretches the ranges of its variables."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, Protocol

import numpy as np

from proto.errors import UserError
from proto.suites import Conditions
from proto.variables import Continuous, Situation, Variable

_STREAM: Final = 2
"""Of the random numbers of a seed, those of a stretched situation."""
_TRIES: Final = 10_000


class DrawnTask(Protocol):
    """What must be known of a task to draw its situations.

    Attributes:
        name: its name in configurations.
        variables: the variables of its situations.
    """

    name: str
    variables: tuple[Variable, ...]

    def sample(self, seed: int) -> Situation:
        """Draw a random situation; the same seed gives the same one."""


def situation_of(task: DrawnTask, conditions: Conditions | None, seed: int) -> Situation:
    """Return the situation that a task draws under conditions; the same seed gives the same one.

    With stretched ranges at least one variable lies outside its own range.

    Raises:
        UserError: the ranges are to be stretched, but the task has no continuous variable.
    """
    situation = task.sample(seed)
    if conditions is None or conditions.stretch == 1.0:
        return situation
    inside = [each for each in task.variables if isinstance(each, Continuous)]
    stretched = [_stretched(each, conditions.stretch) for each in inside]
    if not inside:
        raise UserError(
            f"the task {task.name} cannot be played beyond its ranges: it has no continuous"
            " variable"
        )
    random = np.random.default_rng([_STREAM, seed])
    for _ in range(_TRIES):
        drawn = {each.name: each.draw(random) for each in stretched}
        if any(each.problem(drawn[each.name]) for each in inside):
            return {**situation, **drawn}
    raise UserError(f"a stretch of {conditions.stretch:g} is too small to leave the ranges")


def variables_of(task: DrawnTask, conditions: Conditions | None) -> tuple[Variable, ...]:
    """Return the variables of a task with the ranges that they have under conditions."""
    if conditions is None or conditions.stretch == 1.0:
        return task.variables
    return tuple(
        _stretched(each, conditions.stretch) if isinstance(each, Continuous) else each
        for each in task.variables
    )


def _stretched(variable: Continuous, factor: float) -> Continuous:
    middle = (variable.minimum + variable.maximum) / 2
    half = factor * (variable.maximum - variable.minimum) / 2
    return replace(variable, minimum=middle - half, maximum=middle + half)
