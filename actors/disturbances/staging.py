"""How an episode is staged under the conditions of a suite."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from actors.disturbances.pictures import PICTURE_CHANGES, PictureChange
from actors.disturbances.scenes import (
    SCENE_CHANGES,
    VARIABLE_CHANGES,
    Acting,
    changed_situation,
    changed_variable,
    disturbed_steps,
    shove_between,
    shove_step,
)
from actors.simulator import Scene, Simulator, abilities_of
from actors.tasks.contract import Task
from proto.episode import Image
from proto.errors import UserError
from proto.suites import Conditions, Suite
from proto.variables import Continuous, Situation, Variable, check_situation

_DISTURBANCE, _SITUATION = 1, 2
"""Of the random numbers of a seed, those of the disturbance and those of a stretched situation."""
_TRIES: Final = 10_000


@dataclass(frozen=True)
class Staging:
    """An episode as it is played.

    Attributes:
        scene: the scene, with what happens to it from outside.
        situation: what is true of the object when the hand comes down, and so what is judged.
        changed_at: the control step from which `situation` holds; None if it always does.
        picture: maps the control step and the simulator's picture to the picture that is seen.
    """

    scene: Scene
    situation: Situation
    changed_at: int | None
    picture: PictureChange


def stage(task: Task, situation: Situation, conditions: Conditions | None, seed: int) -> Staging:
    """Stage an episode of a task.

    Args:
        task: the task.
        situation: the situation at the start.
        conditions: conditions of its suite; None for an episode without disturbances.
        seed: seed of the episode, which decides about everything that the disturbance draws.

    Raises:
        UserError: the situation is not one of the task, or the task cannot be disturbed so.
    """
    _check(task, situation, conditions)
    scene = task.scene(situation)
    plain = Staging(scene, situation, None, _as_it_is)
    if conditions is None or not conditions.disturbance:
        return plain
    name, strength = conditions.disturbance, conditions.strength
    random = np.random.default_rng([_DISTURBANCE, seed])
    if name in PICTURE_CHANGES:
        return replace(plain, picture=PICTURE_CHANGES[name](strength, random))
    acting = Acting(strength, random, disturbed_steps(task))
    if name in SCENE_CHANGES:
        return replace(plain, scene=SCENE_CHANGES[name](scene, acting))
    after = changed_situation(task, situation, name, acting)
    step = shove_step(acting)
    shove = shove_between(scene, task.scene(after), step)
    return Staging(replace(scene, shoves=(shove,)), after, step + 1, _as_it_is)


def situation_of(task: Task, conditions: Conditions | None, seed: int) -> Situation:
    """The situation that a task draws under conditions; the same seed gives the same one.

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
    random = np.random.default_rng([_SITUATION, seed])
    for _ in range(_TRIES):
        drawn = {each.name: each.draw(random) for each in stretched}
        if any(each.problem(drawn[each.name]) for each in inside):
            return {**situation, **drawn}
    raise UserError(f"a stretch of {conditions.stretch:g} is too small to leave the ranges")


def check_suite(task: Task, suite: Suite) -> None:
    """Refuse a suite that no actor could play with a task.

    Raises:
        UserError: the task names no variable that a disturbance of the suite changes, or it has no
            range that can be stretched.
    """
    situation_of(task, Conditions(suite.name, suite.stretch), suite.test_seeds.start)
    for name in suite.disturbances.keys() & VARIABLE_CHANGES.keys():
        changed_variable(task, name)


def check_abilities(simulator: Simulator, conditions: Conditions | None) -> None:
    """Refuse conditions for which the simulator lacks an ability.

    Raises:
        UserError: it lacks one; the message names it.
    """
    ability = None if conditions is None else conditions.ability
    if conditions is not None and ability is not None and ability not in abilities_of(simulator):
        raise UserError(
            f"the simulator {simulator.name} cannot play the disturbance"
            f" {conditions.disturbance!r}: it does not support `Scene.{ability}`; choose another"
            " backend or suite"
        )


def _check(task: Task, situation: Situation, conditions: Conditions | None) -> None:
    if conditions is None or conditions.stretch == 1.0:
        task.check(situation)
        return
    variables = [_stretched(each, conditions.stretch) for each in task.variables]
    check_situation(situation, variables, task.name)


def _stretched(variable: Variable, factor: float) -> Variable:
    if not isinstance(variable, Continuous):
        return variable
    middle = (variable.minimum + variable.maximum) / 2
    half = factor * (variable.maximum - variable.minimum) / 2
    return replace(variable, minimum=middle - half, maximum=middle + half)


def _as_it_is(_step: int, image: Image) -> Image:
    return image
