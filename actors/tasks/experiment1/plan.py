"""Plans the tutor's actions in a situation of Experiment I."""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.attention import clip_action
from actors.kinematics import Gaze
from actors.motion import move_through, ramp
from actors.tasks.experiment1.postures import KeyPostures, load_key_postures
from actors.tasks.experiment1.world import (
    START,
    SUBTASKS,
    TABLE_DROP_M,
    object_pose,
    obstacle_pose,
)
from proto.body import ARM, FOCUS, GRASP, NECK
from proto.variables import Situation

Array = NDArray[np.float64]

GAZE_STEPS: Final = 6
"""Control steps of a head movement."""
FOCUS_STEPS: Final = 8
CLOSING_STEPS: Final = 9
LIFTING_STEPS: Final = 14
"""Control steps of the lifting movement; in the rest of the subtask the object is held still."""
OBSTACLE_GAZE_M: Final = np.array([0.0, -0.05, 0.06])
"""Gaze target relative to the obstacle's centre: the upper edge near the hand."""


def plan(situation: Situation) -> Array:
    """Return the tutor's actions (T, 11) in a situation (see `proto.body`)."""
    steps = dict(zip(SUBTASKS, np.cumsum([0, *SUBTASKS.values()]), strict=False))
    total = sum(SUBTASKS.values())
    actions = np.tile(START, (total, 1))
    actions[:, ARM] = _arm(situation, load_key_postures())
    actions[:, NECK] = _neck(situation, steps)
    closing = ramp(total, steps["grasp"], CLOSING_STEPS)
    actions[:, GRASP] = 1.0 + 9.0 * closing
    actions[:, FOCUS] = 1.0 + 19.0 * ramp(total, steps["descend"], FOCUS_STEPS)
    return clip_action(actions)  # between key postures a joint can exceed its limit by a degree


@cache
def _gaze() -> Gaze:
    return Gaze(TABLE_DROP_M)


def _neck(situation: Situation, steps: dict[str, int]) -> Array:
    """Return neck pitch and yaw (T, 2): gaze at the task space, the obstacle, then the object."""
    total = sum(SUBTASKS.values())
    at_obstacle = _gaze().neck_deg(np.array(obstacle_pose(situation).position_m) + OBSTACLE_GAZE_M)
    at_object = _gaze().neck_deg(np.array(object_pose(situation).position_m))
    first = ramp(total, steps["attend obstacle"], GAZE_STEPS)[:, None]
    second = ramp(total, steps["attend object"], GAZE_STEPS)[:, None]
    return np.asarray(
        START[NECK] + (at_obstacle - START[NECK]) * first + (at_object - at_obstacle) * second
    )


def _arm(situation: Situation, postures: KeyPostures) -> Array:
    """Return the arm postures (T, 7): in each subtask the arm follows key postures or rests."""

    def posture(name: str) -> Array:
        return postures.start if name == "start" else postures.arm_deg(name, situation)

    def through(*names: str, moving: int, total: int) -> Array:
        return move_through([posture(name) for name in names], moving, total)

    n = SUBTASKS
    across, reach, descend = n["move over obstacle"], n["reach above object"], n["descend"]
    return np.concatenate(
        [
            np.tile(posture("start"), (n["observe"] + n["attend obstacle"], 1)),
            through("start", "beside", "over", moving=across, total=across),
            np.tile(posture("over"), (n["attend object"], 1)),
            through("over", "above", moving=reach, total=reach),
            through("above", "down_1", "down_2", "grasp", moving=descend, total=descend),
            np.tile(posture("grasp"), (n["grasp"], 1)),
            through("grasp", "lift_1", "lift_2", moving=LIFTING_STEPS, total=n["lift"]),
        ]
    )
