"""Converts the values of an action to a crop of the eye image and joint targets (section 3.2)."""

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
    """Return the crop of the eye image at a focus level from 1 (widest) to 20 (narrowest)."""
    clipped = float(np.clip(level, _MINIMUM[FOCUS], _MAXIMUM[FOCUS]))
    return Crop(round(EYE_WIDTH - 8 * (clipped - 1)), round(EYE_HEIGHT - 6 * (clipped - 1)))


def clip_action(action: Array) -> Array:
    """Clip actions (..., 11) to the robot's limits."""
    return np.asarray(action.clip(_MINIMUM, _MAXIMUM))


def with_attention_of(start: Array, action: Array) -> Array:
    """Return a copy of `action` (11,) with the neck angles and the focus of `start` (11,)."""
    fixed = action.copy()
    fixed[NECK], fixed[FOCUS] = start[NECK], start[FOCUS]
    return fixed


def targets_of_action(action: Array) -> JointTargets:
    """Return the joint targets of an action (11,); the grasp level moves all nine hand motors."""
    return JointTargets(
        neck_deg=action[NECK],
        arm_deg=action[ARM],
        hand_deg=motors_from_grasp(float(action[GRASP])),
    )
