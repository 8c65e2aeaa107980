"""Measurements for judges: when the hand closed, and its pose relative to an object."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from actors.simulator import Pose
from sim_assets.hand import GRASP_AXIS, GRASP_CENTRE_M, closing_fraction

Array = NDArray[np.float64]

CLOSED_FRACTION: Final = 0.15
"""The hand counts as closed from this fraction of its closing movement on."""


@dataclass(frozen=True)
class HandOffset:
    """Pose of the hand relative to an object.

    Attributes:
        yaw_error_deg: yaw of the hand's grasp axis minus yaw of the object, in the task frame,
            -90..90.
        along_mm: offset of the grasp centre along the object's long axis.
        across_mm: horizontal offset of the grasp centre across the object's long axis.
    """

    yaw_error_deg: float
    along_mm: float
    across_mm: float


@dataclass(frozen=True)
class GraspTolerance:
    """Largest errors of a precise grasp.

    Attributes:
        yaw_error_deg, along_mm, across_mm: largest magnitudes of the attributes of `HandOffset`.
    """

    yaw_error_deg: float
    along_mm: float
    across_mm: float

    def allows(self, hand: HandOffset) -> bool:
        """Return whether a pose of the hand is within the tolerance."""
        return (
            abs(hand.yaw_error_deg) <= self.yaw_error_deg
            and abs(hand.along_mm) <= self.along_mm
            and abs(hand.across_mm) <= self.across_mm
        )


def closed_at(joints_deg: Iterable[Array]) -> int:
    """Return the first step from which the hand stays closed to the end, or -1.

    Args:
        joints_deg: measured joints (18,) after each step.
    """
    step = -1
    for k, joints in enumerate(joints_deg):
        if closing_fraction(joints[9:]) < CLOSED_FRACTION:
            step = -1
        elif step < 0:
            step = k
    return step


def hand_offset(hand: Pose, body: Pose) -> HandOffset:
    """Compute the pose of the hand relative to an object."""
    body_yaw_deg = yaw_deg(body)
    axis = rotation_of(hand).apply(GRASP_AXIS)
    hand_yaw_deg = float(np.rad2deg(np.arctan2(axis[1], axis[0])))
    centre = grasp_centre_m(hand) - body.position_m
    turn = np.deg2rad(body_yaw_deg)
    return HandOffset(
        yaw_error_deg=half_turn(body_yaw_deg - hand_yaw_deg),  # the task frame is left-handed
        along_mm=1e3 * float(-centre[0] * np.sin(turn) + centre[1] * np.cos(turn)),
        across_mm=1e3 * float(centre[0] * np.cos(turn) + centre[1] * np.sin(turn)),
    )


def grasp_centre_m(hand: Pose) -> Array:
    """Return the grasp centre (3,) of the hand in the world frame."""
    return np.asarray(hand.position_m + rotation_of(hand).apply(GRASP_CENTRE_M))


def rotation_of(pose: Pose) -> Rotation:
    """Return the rotation of a pose."""
    w, x, y, z = pose.quaternion
    return Rotation.from_quat((x, y, z, w))


def yaw_deg(pose: Pose) -> float:
    """Return the rotation of a pose about the vertical, in the world frame (degrees)."""
    w, x, y, z = pose.quaternion
    return float(np.rad2deg(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))


def tilt_deg(pose: Pose) -> float:
    """Return the angle between the z axis of a body and the vertical (degrees)."""
    _, x, y, _ = pose.quaternion
    return float(np.rad2deg(np.arccos(np.clip(1 - 2 * (x * x + y * y), -1.0, 1.0))))


def half_turn(angle_deg: float) -> float:
    """Reduce an angle to -90..90 degrees; a box looks the same after a rotation by 180 degrees."""
    return (angle_deg + 90.0) % 180.0 - 90.0
