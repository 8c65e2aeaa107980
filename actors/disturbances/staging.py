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
from proto.situations import situation_of, variables_of
from proto.suites import Conditions, Suite
from proto.variables import Situation, check_situation

_DISTURBANCE: Final = 1
"""Of the random numbers of a seed, those of the disturbance."""


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
        UserError: the task cannot be disturbed so, or the scene cannot be made.
    """
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


def checked_staging(
    simulator: Simulator, task: Task, situation: Situation, conditions: Conditions | None, seed: int
) -> Staging:
    """Stage an episode that a simulator is to play; see `stage`.

    Raises:
        UserError: the situation is none of the task, or task or simulator cannot be disturbed as
            the conditions say.
    """
    check_abilities(simulator, conditions)
    check_staged(task, situation, conditions)
    return stage(task, situation, conditions, seed)


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


def check_staged(task: Task, situation: Situation, conditions: Conditions | None) -> None:
    """Check that a situation is one of a task, in the ranges that it has under conditions.

    A recorded episode can be shown without that: the task may have had other options.

    Raises:
        UserError: it is none.
    """
    if conditions is None or conditions.stretch == 1.0:
        task.check(situation)
        return
    check_situation(situation, variables_of(task, conditions), task.name)


def _as_it_is(_step: int, image: Image) -> Image:
    return image
