"""The world of Experiment I: table, obstacle, object, and duration of the subtasks.

Task frame of the paper: X lateral (negative is the robot's right), Y forward, Z up, left-handed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from actors.attention import targets_of_action
from actors.simulator import Box, Pose, Scene
from proto.variables import Situation, number_of

OBSTACLE_X_M: Final = (-0.22, -0.27, -0.32)
OBJECT_Y_M: Final = (0.20, 0.25, 0.30)
OBJECT_YAW_DEG: Final = (-45.0, -22.5, 0.0, 22.5, 45.0)
GRID: Final[Mapping[str, tuple[float, ...]]] = {
    "obstacle_x_m": OBSTACLE_X_M,
    "object_y_m": OBJECT_Y_M,
    "object_yaw_deg": OBJECT_YAW_DEG,
}
"""Tutored values of each variable, 3 x 3 x 5 as in the paper; they span the variable's range."""
MIDDLE: Final[Situation] = {"obstacle_x_m": -0.27, "object_y_m": 0.25, "object_yaw_deg": 0.0}
"""The situation in the middle of the ranges."""

# The sizes are those of the paper. The paper does not give the object's X, the obstacle's Y and the
# height of the table; these values let the arm reach all corners of the ranges.
OBJECT_SIZE_M: Final = (0.028, 0.10, 0.07)
OBJECT_X_M: Final = -0.04
OBJECT_MASS_KG: Final = 0.1
OBSTACLE_SIZE_M: Final = (0.01, 0.26, 0.20)
OBSTACLE_Y_M: Final = 0.30
TABLE_SIZE_M: Final = (0.90, 0.44, 0.04)
TABLE_CENTRE_M: Final = (0.05, 0.31)
TABLE_DROP_M: Final = 0.15
FRICTION: Final = 1.0

SUBTASKS: Final[Mapping[str, int]] = {
    "observe": 8,
    "attend obstacle": 10,
    "move over obstacle": 22,
    "attend object": 10,
    "reach above object": 20,
    "descend": 20,
    "grasp": 14,
    "lift": 20,
}
"""The eight subtasks of the paper and their control steps."""

START: Final = np.array([-32.0, -23.0, -3.0, 54.0, -22.0, 18.0, -32.0, -9.0, 10.0, 1.0, 1.0])
"""Posture and levels at the start of every episode (see `proto.body`)."""


def object_pose(situation: Situation) -> Pose:
    """Return the pose of the object at the start, in the world frame."""
    half_turn = np.deg2rad(-number_of(situation, "object_yaw_deg")) / 2
    return Pose(
        (-OBJECT_X_M, number_of(situation, "object_y_m"), OBJECT_SIZE_M[2] / 2),
        (float(np.cos(half_turn)), 0.0, 0.0, float(np.sin(half_turn))),
    )


def obstacle_pose(situation: Situation) -> Pose:
    """Return the pose of the obstacle, in the world frame."""
    return Pose((-number_of(situation, "obstacle_x_m"), OBSTACLE_Y_M, OBSTACLE_SIZE_M[2] / 2))


def scene(situation: Situation) -> Scene:
    """Return the scene: table, object, and the obstacle if the situation has one."""
    return Scene(
        boxes=(_table(), *_obstacles(situation), _object(situation)),
        start=targets_of_action(START),
        table_drop_m=TABLE_DROP_M,
    )


def _table() -> Box:
    place = Pose((*TABLE_CENTRE_M, -TABLE_SIZE_M[2] / 2))
    return Box("table", TABLE_SIZE_M, place, (0.75, 0.72, 0.65), friction=FRICTION)


def _obstacles(situation: Situation) -> tuple[Box, ...]:
    if "obstacle_x_m" not in situation:
        return ()
    place, colour = obstacle_pose(situation), (0.9, 0.8, 0.1)
    return (Box("obstacle", OBSTACLE_SIZE_M, place, colour, friction=FRICTION, watched=True),)


def _object(situation: Situation) -> Box:
    return Box(
        "object",
        OBJECT_SIZE_M,
        object_pose(situation),
        (0.8, 0.1, 0.1),
        mass_kg=OBJECT_MASS_KG,
        friction=FRICTION,
    )
