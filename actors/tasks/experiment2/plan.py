"""The tutor's plan for a situation: the whole behaviour of Experiment II, step by step."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.attention import clip_action
from actors.kinematics import Gaze
from actors.motion import move_through, ramp
from actors.tasks.experiment2.postures import FamilyPostures, load_key_postures
from actors.tasks.experiment2.setting import PlacedObject, Setting
from actors.tasks.experiment2.world import START, SUBTASKS, TABLE_DROP_M, first_steps
from proto.body import ARM, FOCUS, GRASP, NECK
from proto.variables import Situation

Array = NDArray[np.float64]

DOWNWARD_STEPS: Final = 7
"""The head turns from the screen to the task space in this many control steps."""
GAZE_STEPS: Final = 6
"""The head turns to the object in this many control steps, then it rests."""
FOCUS_STEPS: Final = 8
CLOSING_STEPS: Final = 9
LIFTING_STEPS: Final = 14
"""The last steps of the lift hold the object still."""
TASK_SPACE_M: Final = np.array([0.04, 0.25, 0.04])
"""Point between the two places (world frame) at which the robot sees both."""


def plan(situation: Situation, subtasks: Mapping[str, int] = SUBTASKS) -> Array:
    """Return the tutor's actions (T, 11) in a situation (see `proto.body`).

    Args:
        situation: the situation.
        subtasks: number of control steps of each subtask, T in all; see `world.delayed_subtasks`.
    """
    target = Setting.of(situation).indicated
    begins, total = first_steps(subtasks), sum(subtasks.values())
    actions = np.tile(START, (total, 1))
    actions[:, ARM] = _arm(target, load_key_postures().for_object(target), subtasks)
    actions[:, NECK] = _neck(target, begins, total)
    actions[:, GRASP] = 1.0 + 9.0 * ramp(total, begins["grasp"], CLOSING_STEPS)
    actions[:, FOCUS] = 1.0 + 19.0 * ramp(total, begins["approach"], FOCUS_STEPS)
    return clip_action(actions)  # between key postures a joint may pass its limit by a degree


@cache
def _gaze() -> Gaze:
    return Gaze(TABLE_DROP_M)


def _neck(target: PlacedObject, begins: Mapping[str, int], total: int) -> Array:
    """Neck pitch and yaw (total, 2): the screen, then the task space, then the object."""
    at_task_space = _gaze().neck_deg(TASK_SPACE_M)
    at_object = _gaze().neck_deg(np.array(target.pose.position_m))
    first = ramp(total, begins["attend task space"], DOWNWARD_STEPS)[:, None]
    second = ramp(total, begins["attend object"], GAZE_STEPS)[:, None]
    return np.asarray(
        START[NECK] + (at_task_space - START[NECK]) * first + (at_object - at_task_space) * second
    )


def _arm(target: PlacedObject, postures: FamilyPostures, subtasks: Mapping[str, int]) -> Array:
    """Arm postures (T, 7): each subtask moves through its key postures or rests."""

    def posture(name: str) -> Array:
        return START[ARM] if name == "start" else postures.arm_deg(name, target)

    def through(*names: str, moving: int, total: int) -> Array:
        return move_through([posture(name) for name in names], moving, total)

    resting = first_steps(subtasks)["reach above object"]
    reach, approach = subtasks["reach above object"], subtasks["approach"]
    return np.concatenate(
        [
            np.tile(posture("start"), (resting, 1)),
            through("start", "passing", "above", moving=reach, total=reach),
            through("above", "approach_1", "approach_2", "grasp", moving=approach, total=approach),
            np.tile(posture("grasp"), (subtasks["grasp"], 1)),
            through("grasp", "lift_1", "lift_2", moving=LIFTING_STEPS, total=subtasks["lift"]),
        ]
    )
