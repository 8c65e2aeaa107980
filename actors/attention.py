"""Attention (paper, section 3.2): what the levels in an action mean for eye and motors."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.simulator import EYE_HEIGHT, EYE_WIDTH, Crop, JointTargets
from proto.body import ACTION_VALUES, ARM, FOCUS, GRASP, NECK
from sim_assets.hand import motors_from_grasp

Array = NDArray[np.float64]

_MINIMUM: Final = np.array([value.minimum for value in ACTION_VALUES])
_MAXIMUM: Final = np.array([value.maximum for value in ACTION_VALUES])


def crop_of_focus(level: float) -> Crop:
    """The part of the eye image that a focus level (1 wide .. 20 fovea) shows the network."""
    z = float(np.clip(level, _MINIMUM[FOCUS], _MAXIMUM[FOCUS]))
    return Crop(round(EYE_WIDTH - 8 * (z - 1)), round(EYE_HEIGHT - 6 * (z - 1)))


def clip_action(action: Array) -> Array:
    """Actions (..., 11) within the robot's limits."""
    return np.asarray(action.clip(_MINIMUM, _MAXIMUM))


def attention_of(start: Array, action: Array) -> Array:
    """The action (11,) with neck and focus as in `start` (11,)."""
    held = action.copy()
    held[NECK], held[FOCUS] = start[NECK], start[FOCUS]
    return held


def targets_of_action(action: Array) -> JointTargets:
    """Joint targets for an action (11,); the grasp level moves all nine hand motors together."""
    return JointTargets(
        neck_deg=action[NECK],
        arm_deg=action[ARM],
        hand_deg=motors_from_grasp(float(action[GRASP])),
    )
