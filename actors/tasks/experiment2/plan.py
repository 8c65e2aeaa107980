"""The tutor's plan for a situation: the whole behaviour of Experiment II, step by step."""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.attention import clip_action
from actors.kinematics import Gaze
from actors.motion import move_through, ramp
from actors.tasks.experiment2.postures import FamilyPostures, load_key_postures
from actors.tasks.experiment2.setting import PlacedObject, Setting
from actors.tasks.experiment2.world import START, SUBTASKS, TABLE_DROP_M
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

_TOTAL: Final = sum(SUBTASKS.values())


def plan(situation: Situation) -> Array:
    """Actions (148, 11) that carry out Experiment II in a situation (see `proto.body`)."""
    target = Setting.of(situation).indicated
    begins = dict(zip(SUBTASKS, np.cumsum([0, *SUBTASKS.values()]).tolist(), strict=False))
    actions = np.tile(START, (_TOTAL, 1))
    actions[:, ARM] = _arm(target, load_key_postures().for_object(target))
    actions[:, NECK] = _neck(target, begins)
    actions[:, GRASP] = 1.0 + 9.0 * ramp(_TOTAL, begins["grasp"], CLOSING_STEPS)
    actions[:, FOCUS] = 1.0 + 19.0 * ramp(_TOTAL, begins["approach"], FOCUS_STEPS)
    return clip_action(actions)  # between key postures a joint may pass its limit by a degree


@cache
def _gaze() -> Gaze:
    return Gaze(TABLE_DROP_M)


def _neck(target: PlacedObject, begins: dict[str, int]) -> Array:
    """Neck pitch and yaw (148, 2): the screen, then the task space, then the object."""
    at_task_space = _gaze().neck_deg(TASK_SPACE_M)
    at_object = _gaze().neck_deg(np.array(target.pose.position_m))
    first = ramp(_TOTAL, begins["attend task space"], DOWNWARD_STEPS)[:, None]
    second = ramp(_TOTAL, begins["attend object"], GAZE_STEPS)[:, None]
    return np.asarray(
        START[NECK] + (at_task_space - START[NECK]) * first + (at_object - at_task_space) * second
    )


def _arm(target: PlacedObject, postures: FamilyPostures) -> Array:
    """Arm postures (148, 7): each subtask moves through its key postures or rests."""

    def posture(name: str) -> Array:
        return START[ARM] if name == "start" else postures.arm_deg(name, target)

    def through(*names: str, moving: int, total: int) -> Array:
        return move_through([posture(name) for name in names], moving, total)

    n = SUBTASKS
    waiting = sum(n[name] for name in list(n)[:4])
    reach, approach = n["reach above object"], n["approach"]
    return np.concatenate(
        [
            np.tile(posture("start"), (waiting, 1)),
            through("start", "passing", "above", moving=reach, total=reach),
            through("above", "approach_1", "approach_2", "grasp", moving=approach, total=approach),
            np.tile(posture("grasp"), (n["grasp"], 1)),
            through("grasp", "lift_1", "lift_2", moving=LIFTING_STEPS, total=n["lift"]),
        ]
    )
