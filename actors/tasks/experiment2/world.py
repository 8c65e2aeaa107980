"""The world of Experiment II: a table, two objects, and a screen behind them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from actors.attention import targets_of_action
from actors.simulator import Box, Pose, Scene, Screen
from actors.tasks.experiment2.setting import Kind, PlacedObject, Setting
from sim_assets.gestures.clip import Clip

SUBTASKS: Final[Mapping[str, int]] = {
    "observe gesture": 40,
    "attend task space": 8,
    "observe task space": 10,
    "attend object": 10,
    "reach above object": 26,
    "approach": 20,
    "grasp": 14,
    "lift": 20,
}
"""The eight subtasks of the paper and the number of control steps of each."""
WAIT: Final = "wait"
"""Name of the subtask between the gesture and the turn of the head, if there is a delay."""
LONGEST_DELAY: Final = 200
"""Largest number of control steps of that subtask."""

START: Final = np.array([26.4, -1.8, -3.0, 54.0, -22.0, 18.0, -32.0, -9.0, 10.0, 1.0, 1.0])
"""Action (11,) whose posture every episode starts from: the eye looks at the screen."""

Y_RANGE_M: Final = (0.235, 0.275)
YAW_RANGE_DEG: Final = (-12.0, 12.0)
"""Ranges of both objects.

Nearer, the elbow cannot bend enough for a standing object at X = -0.15; farther, the hand does not
come down to a laying object at X = 0.07; turned farther, the wrist cannot follow a standing object
at X = 0.07.
"""

# The height of the table is where the arm reaches every family over the whole ranges.
TABLE_SIZE_M: Final = (0.90, 0.44, 0.04)
TABLE_CENTRE_M: Final = (0.05, 0.31)
TABLE_DROP_M: Final = 0.14
OBJECT_MASS_KG: Final = 0.1
FRICTION: Final = 1.0

SCREEN_SIZE_M: Final = (1.0, 1.0)
SCREEN_CENTRE_M: Final = (0.0, 1.2, 0.42)
"""In the world frame; from there the screen fills two thirds of the eye's picture."""

COLOURS: Final[Mapping[Kind, tuple[float, float, float]]] = {
    "standing": (0.50, 0.05, 0.05),
    "laying": (0.85, 0.30, 0.10),
}
"""The kinds differ in shade, so that a picture of 64 x 48 grey pixels tells them apart."""


def delayed_subtasks(delay_steps: int) -> Mapping[str, int]:
    """Return the subtasks with a delay after the gesture; without delay the eight of the paper."""
    if not delay_steps:
        return SUBTASKS
    gesture, *others = SUBTASKS.items()
    return dict([gesture, (WAIT, delay_steps), *others])


def first_steps(subtasks: Mapping[str, int]) -> dict[str, int]:
    """Return the control step at which each subtask begins."""
    ends = np.cumsum(list(subtasks.values()))
    return {
        name: int(end) - steps for (name, steps), end in zip(subtasks.items(), ends, strict=True)
    }


def scene(setting: Setting, clip: Clip) -> Scene:
    """Table and objects, and the screen that shows a clip (40, 96, 96) uint8."""
    return Scene(
        boxes=(_table(), _box(setting.indicated), _box(setting.other)),
        start=targets_of_action(START),
        table_drop_m=TABLE_DROP_M,
        screen=Screen(SCREEN_SIZE_M, Pose(SCREEN_CENTRE_M), clip),
    )


def _table() -> Box:
    place = Pose((*TABLE_CENTRE_M, -TABLE_SIZE_M[2] / 2))
    return Box("table", TABLE_SIZE_M, place, (0.75, 0.72, 0.65), friction=FRICTION)


def _box(placed: PlacedObject) -> Box:
    return Box(
        placed.name,
        placed.size_m,
        placed.pose,
        COLOURS[placed.kind],
        mass_kg=OBJECT_MASS_KG,
        friction=FRICTION,
    )
