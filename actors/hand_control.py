"""Moves the right hand for a person: inverse kinematics by small steps, clear of fixed boxes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import KDTree

from actors.kinematics import Arm, ArmPose, ClearanceBox
from actors.simulator import Box, Scene
from actors.tasks.contract import Task
from proto.body import ACTION_VALUES, ARM
from sim_assets.hand import APPROACH_AXIS, GRASP_AXIS, OPEN_DEG

Array = NDArray[np.float64]

# Scales of the residuals: a deviation of one scale gives a residual of 1.
_POSITION_M: Final = 0.001
_YAW_RAD: Final = np.deg2rad(2.0)
_LEVEL_RAD: Final = np.deg2rad(15.0)
_STEEP_RAD: Final = np.deg2rad(8.0)
_CHANGE_RAD: Final = np.deg2rad(20.0)
_UNFAMILIAR_RAD: Final = np.deg2rad(20.0)
_CLEARANCE_M: Final = 0.002
_STEEPEST_RAD: Final = np.deg2rad(40.0)
_BOX_MARGIN_M: Final = 0.018
_TABLE_MARGIN_M: Final = 0.004
_INSIDE_LIMITS_RAD: Final = np.deg2rad(0.2)
_FASTEST_RAD: Final = np.deg2rad(8.0)
"""A joint moves by at most this in a control step."""
_NEAREST: Final = 16
_EQUALLY_NEAR_M: Final = 0.01
"""Places that differ by less in their distance count nearly the same."""
_LEVER_M: Final = 0.1
"""A turn by one radian counts as much as a shift by this length."""
STEP_M: Final = 0.02
STEP_TURN_DEG: Final = 10.0


@dataclass(frozen=True)
class HandPlace:
    """Where the hand is, or should be.

    Attributes:
        centre_m: (3,) the grasp centre in the world frame.
        yaw_deg: direction of the grasp axis, from the thumb to the fingers, about the vertical;
            counter-clockwise from above, 0 along the x axis of the world frame.
    """

    centre_m: Array
    yaw_deg: float

    def moved(self, shift_m: Array, turn_deg: float = 0.0) -> HandPlace:
        """Return the place after a shift (3,) in the world frame and a turn."""
        return HandPlace(self.centre_m + shift_m, self.yaw_deg + turn_deg)

    def along_own_axes(self, shift_m: Array) -> Array:
        """Return a shift (3,) along the axes of the level hand in the world frame.

        The axes: along the grasp axis, horizontally at a right angle to it, and upwards.
        """
        cos, sin = math.cos(math.radians(self.yaw_deg)), math.sin(math.radians(self.yaw_deg))
        x, y, z = shift_m
        return np.array([cos * x - sin * y, sin * x + cos * y, z])


class FamiliarPostures:
    """Postures of the arm in which it has been before, by the place of the hand.

    Seven joints can bring the hand to a place in many postures. From most of them the arm cannot go
    on, because joints are at their limits. A tutor's lead to where a task needs the hand.
    """

    def __init__(self, arm: Arm, postures_rad: Array) -> None:
        """Remember postures (N, 7) in radians of an arm."""
        self._postures = postures_rad
        self._places = KDTree([_coordinates(_place(arm.pose(each))) for each in postures_rad])

    @classmethod
    def of_tutor(cls, task: Task) -> Self:
        """Remember the postures of the tutor in all tutored cases; takes a second or two."""
        tutored = task.tutored()
        arm = Arm(OPEN_DEG, task.scene(tutored[0]).table_drop_m)
        postures = np.concatenate([task.plan(situation)[:, ARM] for situation in tutored])
        return cls(arm, np.deg2rad(np.unique(postures.round(2), axis=0)))

    def near(self, place: HandPlace) -> Array:
        """Return a posture (7,) in radians, the mean of those that have the hand near a place."""
        count = min(_NEAREST, len(self._postures))
        far, nearest = self._places.query(_coordinates(place), range(1, count + 1))
        weights = np.exp(-((far / (far[0] + _EQUALLY_NEAR_M)) ** 2))
        return np.asarray(weights @ self._postures[nearest] / weights.sum())


class HandControl:
    """Finds arm postures that bring the hand to a place near the one where it is.

    The fingers point downwards as far as the arm can, and the arm keeps clear of the table and of
    all boxes that never move.
    """

    def __init__(self, scene: Scene, familiar: FamiliarPostures) -> None:
        """Make the arm's model with an open hand.

        Args:
            scene: gives the height of the robot and the fixed boxes.
            familiar: of all postures that bring the hand to a place, the arm prefers one that is
                like these.
        """
        self._arm = Arm(OPEN_DEG, scene.table_drop_m)
        self._fixed = [
            _clearance_box(box)
            for box in scene.boxes
            if box.mass_kg is None and box.pose.position_m[2] > 0.0  # the table lies below
        ]
        self._familiar = familiar
        limits = ACTION_VALUES[ARM]
        self._minimum = np.deg2rad([value.minimum for value in limits]) + _INSIDE_LIMITS_RAD
        self._maximum = np.deg2rad([value.maximum for value in limits]) - _INSIDE_LIMITS_RAD

    def place(self, arm_deg: Array) -> HandPlace:
        """Return where the hand is with arm angles (7,) in degrees."""
        return _place(self._arm.pose(np.deg2rad(arm_deg)))

    def towards(self, arm_deg: Array, wanted: HandPlace) -> Array:
        """Return arm angles (7,) in degrees for one control step towards a place.

        Args:
            arm_deg: (7,) the last commanded arm angles (degrees).
            wanted: where the hand should be. The step is at most STEP_M and STEP_TURN_DEG long.
        """
        here = self.place(arm_deg)
        way = wanted.centre_m - here.centre_m
        share = min(1.0, STEP_M / max(float(np.linalg.norm(way)), 1e-9))
        turn = _wrapped(wanted.yaw_deg - here.yaw_deg)
        aim = here.moved(share * way, min(max(turn, -STEP_TURN_DEG), STEP_TURN_DEG))
        before = np.deg2rad(arm_deg).clip(self._minimum, self._maximum)
        preferred = self._familiar.near(aim)
        found = least_squares(
            lambda posture: self._residuals(posture, before, preferred, aim),
            before,
            bounds=(
                np.maximum(self._minimum, before - _FASTEST_RAD) - 1e-9,
                np.minimum(self._maximum, before + _FASTEST_RAD) + 1e-9,
            ),
            max_nfev=6,
            xtol=1e-4,
            ftol=1e-4,
        )
        return np.asarray(np.rad2deg(found.x))

    def misses(self, arm_deg: Array, wanted: HandPlace) -> tuple[float, float]:
        """Return how far the hand is from a place (m), and how far it is turned away (degrees)."""
        here = self.place(arm_deg)
        far_m = float(np.linalg.norm(wanted.centre_m - here.centre_m))
        return far_m, abs(_wrapped(wanted.yaw_deg - here.yaw_deg))

    def _residuals(
        self, posture: Array, before: Array, preferred: Array, wanted: HandPlace
    ) -> Array:
        pose = self._arm.pose(posture)
        axis = pose.rotation @ GRASP_AXIS
        yaw = math.radians(wanted.yaw_deg)
        beside = -math.sin(yaw) * axis[0] + math.cos(yaw) * axis[1]
        down = -(pose.rotation @ APPROACH_AXIS)[2]
        too_near = [
            np.maximum(0.0, _BOX_MARGIN_M - self._arm.clearances(pose, box)) for box in self._fixed
        ]
        too_low = np.maximum(0.0, _TABLE_MARGIN_M - self._arm.heights(pose))
        return np.concatenate(
            [
                (pose.grasp_centre_m - wanted.centre_m) / _POSITION_M,
                [beside / _YAW_RAD, axis[2] / _LEVEL_RAD],
                [max(0.0, math.cos(_STEEPEST_RAD) - down) / _STEEP_RAD],
                *(missing / _CLEARANCE_M for missing in (*too_near, too_low)),
                (posture - before) / _CHANGE_RAD,
                (posture - preferred) / _UNFAMILIAR_RAD,
            ]
        )


def _place(pose: ArmPose) -> HandPlace:
    axis = pose.rotation @ GRASP_AXIS
    return HandPlace(pose.grasp_centre_m, math.degrees(math.atan2(axis[1], axis[0])))


def _coordinates(place: HandPlace) -> Array:
    """Coordinates (5,) in which places are near each other if their postures can be similar."""
    yaw = math.radians(place.yaw_deg)
    return np.array([*place.centre_m, math.cos(yaw) * _LEVER_M, math.sin(yaw) * _LEVER_M])


def _wrapped(angle_deg: float) -> float:
    """Reduce an angle to -180..180 degrees."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def _clearance_box(box: Box) -> ClearanceBox:
    w, x, y, z = box.pose.quaternion
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return ClearanceBox(np.array(box.pose.position_m), np.array(box.size_m), yaw)
