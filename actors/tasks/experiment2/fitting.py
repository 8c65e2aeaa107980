"""Fits the tutor's key postures to the task.

Run with `python -m actors.tasks.experiment2.fitting`.

Each key posture is a polynomial of the object's Y and yaw. `actors.posture_fitting` finds its
coefficients over a grid of situations at once: the hand where it should be, clear of the table and
of both objects, within the joints' limits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.kinematics import Arm, ArmPose, ClearanceBox
from actors.motion import interpolate_postures
from actors.posture_fitting import (
    ANGLE,
    LOOSE_POSITION,
    POSITION,
    fit_polynomial,
    limit_violations,
    shortfall,
    write_postures,
)
from actors.tasks.experiment2.postures import (
    FAMILIES,
    FITTED,
    ORDERS,
    Family,
    FamilyPostures,
    KeyPostures,
    features,
)
from actors.tasks.experiment2.setting import KINDS, PlacedObject, other_place
from actors.tasks.experiment2.world import START, TABLE_DROP_M, Y_RANGE_M, YAW_RANGE_DEG
from proto.body import ARM
from sim_assets.hand import APPROACH_AXIS, GRASP_AXIS, OPEN_DEG

Array = NDArray[np.float64]

OBJECT_MARGIN_M: Final = 0.006
OTHER_MARGIN_M: Final = 0.015
PASSING_MARGIN_M: Final = 0.020
LIFTING_MARGIN_M: Final = 0.030
TABLE_MARGIN_M: Final = 0.004
LIFT_M: Final = 0.11
GRID_POINTS: Final = 4
"""Values of Y, and of yaw, in the grid of situations."""


@dataclass(frozen=True)
class GraspStyle:
    """How one family is grasped.

    Attributes:
        height_m: of the grasp centre above the table.
        retreat_m: distance from the grasp to the posture above the object.
        backwards: share of the approach direction in the direction of the retreat; 0 is straight
            up. A retreat that leans back from a standing object at X = -0.15 topples it.
        guess_deg: (7,) arm posture from which the fit starts.
    """

    height_m: float
    retreat_m: float
    backwards: float
    guess_deg: tuple[float, ...]


STYLES: Final[Mapping[Family, GraspStyle]] = {
    ("standing", "-0.15"): GraspStyle(
        0.095, 0.090, 0.0, (5.6, 64.0, 53.5, 99.8, -85.8, -48.7, -16.1)
    ),
    ("standing", "0.07"): GraspStyle(
        0.088, 0.105, 0.6, (-25.0, 3.0, 75.0, 66.0, -50.0, -78.0, 5.0)
    ),
    ("laying", "-0.15"): GraspStyle(
        0.035, 0.095, 0.0, (-30.0, 56.0, 70.0, 70.0, -80.0, -30.0, 35.0)
    ),
    ("laying", "0.07"): GraspStyle(0.035, 0.095, 0.0, (-38.0, 4.0, 75.0, 50.0, -62.0, -62.0, 35.0)),
}
RAISED_RAD: Final = np.deg2rad([-15.0, 20.0, 0.0, 15.0, 0.0, 0.0, 0.0])
"""What the fit of the passing posture adds to the middle of start and end at first: the arm up."""
STANDING_TILT_RAD: Final = np.deg2rad(60.0)
"""Approach of a standing object, from the vertical: from its side, as in the paper."""
STEEPEST_LAYING_TILT_RAD: Final = np.deg2rad(30.0)
"""Approach of a laying object, from the vertical: from above, as in the paper."""


class FamilyFitter:
    """The residuals of each key posture of one family, and the order in which they are fitted."""

    def __init__(self, family: Family) -> None:
        """Set up the arm with the hand open, and the grid of situations."""
        self._kind, self._place = family
        self._style = STYLES[family]
        self._arm = Arm(OPEN_DEG, TABLE_DROP_M)
        self._start = np.deg2rad(START[ARM])
        grid = [
            PlacedObject("indicated", *family, float(y), float(yaw))
            for y in np.linspace(*Y_RANGE_M, GRID_POINTS)
            for yaw in np.linspace(*YAW_RANGE_DEG, GRID_POINTS)
        ]
        self._boxes = [_clearance_box(placed) for placed in grid]
        self._features = np.array([features(placed.y_m, placed.yaw_deg) for placed in grid])
        self._others = [
            _clearance_box(PlacedObject("other", kind, other_place(self._place), y, 0.0))
            for kind in KINDS
            for y in Y_RANGE_M
        ]

    def fit(self) -> FamilyPostures:
        """Fit all key postures of the family."""
        grasp = self._fit_grasp()
        fitted = {"grasp": grasp}
        below = grasp
        for name, share in (("approach_2", 1 / 3), ("approach_1", 2 / 3), ("above", 1.0)):
            below = fitted[name] = self._fit_retreat(grasp, below, share)
        below = grasp
        for name, height in (("lift_1", LIFT_M / 2), ("lift_2", LIFT_M)):
            below = fitted[name] = self._fit_lift(grasp, below, height)
        return FamilyPostures(
            passing=np.rad2deg(self._fit_passing(fitted["above"])),
            at_object={name: np.rad2deg(rows) for name, rows in fitted.items()},
        )

    def _limits(self, posture: Array) -> Array:
        return limit_violations(self._arm, posture)

    def _table(self, pose: ArmPose, margin_m: float = TABLE_MARGIN_M) -> Array:
        return shortfall(self._arm.heights(pose), margin_m)

    def _clear_of_others(self, pose: ArmPose, margin_m: float) -> Array:
        """Clearance of the other object, of either kind, at both ends of its range."""
        return np.concatenate(
            [shortfall(self._arm.clearances(pose, box).min(), margin_m) for box in self._others]
        )

    def _clear(self, pose: ArmPose, box: ClearanceBox) -> Array:
        """Clearance of the object, the table and the other object while the hand is open."""
        return np.concatenate(
            [
                shortfall(self._arm.clearances(pose, box), OBJECT_MARGIN_M),
                self._table(pose),
                self._clear_of_others(pose, OTHER_MARGIN_M),
            ]
        )

    def _tilt(self, pose: ArmPose) -> float:
        """Residual of the approach's angle from the vertical."""
        down = -(pose.rotation @ APPROACH_AXIS)[2]
        tilt = np.arccos(np.clip(down, -1.0, 1.0))
        if self._kind == "standing":
            return float((tilt - STANDING_TILT_RAD) / (5 * ANGLE))
        return float(max(0.0, tilt - STEEPEST_LAYING_TILT_RAD) / (4 * ANGLE))

    def _fit_grasp(self) -> Array:
        """The open hand around the object."""
        guess = np.deg2rad(self._style.guess_deg)
        start = np.zeros((len(ORDERS), 7))
        start[0] = guess

        def residual(posture: Array, i: int) -> Array:
            pose, box = self._arm.pose(posture), self._boxes[i]
            across, along = box.level_axes()
            target = np.array([*box.centre_m[:2], self._style.height_m])
            offset = pose.grasp_centre_m - target
            axis = pose.rotation @ GRASP_AXIS
            return np.concatenate(
                [
                    [offset @ across / POSITION, offset @ along / (3 * POSITION)],
                    [offset[2] / (2 * POSITION)],
                    [axis @ along / ANGLE, axis[2] / (4 * ANGLE), self._tilt(pose)],
                    self._clear(pose, box),
                    self._limits(posture),
                    (posture - guess) / (60 * ANGLE),
                ]
            )

        return fit_polynomial(self._features, residual, start, ORDERS)

    def _fit_retreat(self, grasp: Array, below: Array, share: float) -> Array:
        """The open hand, moved back from its grasp by a share of the retreat, turned alike."""
        grasps = [self._arm.pose(posture) for posture in self._features @ grasp]
        targets = [pose.grasp_centre_m + share * self._retreat_m(pose) for pose in grasps]
        before = self._features @ below
        loose = 1.0 + 4.0 * share

        def residual(posture: Array, i: int) -> Array:
            pose, box = self._arm.pose(posture), self._boxes[i]
            _, along = box.level_axes()
            offset = pose.grasp_centre_m - targets[i]
            axis = pose.rotation @ GRASP_AXIS
            turned = (pose.rotation - grasps[i].rotation) @ APPROACH_AXIS
            return np.concatenate(
                [
                    offset / (loose * POSITION * np.array([1.0, 1.5, 2.0])),
                    [axis @ along / (ANGLE * loose), axis[2] / (4 * ANGLE * loose)],
                    turned / (3 * ANGLE * loose),
                    self._clear(pose, box),
                    self._limits(posture),
                    (posture - before[i]) / (15 * ANGLE),
                ]
            )

        return fit_polynomial(self._features, residual, below, ORDERS)

    def _retreat_m(self, grasp: ArmPose) -> Array:
        """Vector (3,) from the grasp to above the object."""
        approach = grasp.rotation @ APPROACH_AXIS
        direction = np.array([0.0, 0.0, 1.0]) - self._style.backwards * approach
        return np.asarray(self._style.retreat_m * direction / np.linalg.norm(direction))

    def _fit_lift(self, grasp: Array, below: Array, height_m: float) -> Array:
        """The grasped object raised, held level enough, free to drift sideways a little."""
        grasps = [self._arm.pose(posture) for posture in self._features @ grasp]
        before = self._features @ below

        def residual(posture: Array, i: int) -> Array:
            pose = self._arm.pose(posture)
            offset = pose.grasp_centre_m - grasps[i].grasp_centre_m - np.array([0.0, 0.0, height_m])
            return np.concatenate(
                [
                    offset / [3 * LOOSE_POSITION, 3 * LOOSE_POSITION, 3 * POSITION],
                    ((pose.rotation - grasps[i].rotation) / (10 * ANGLE)).ravel(),
                    self._table(pose),
                    self._clear_of_others(pose, LIFTING_MARGIN_M),
                    self._limits(posture),
                    (posture - before[i]) / (10 * ANGLE),
                ]
            )

        return fit_polynomial(self._features, residual, below, ORDERS)

    def _fit_passing(self, above: Array) -> Array:
        """One posture (7,) between the start and above the object, clear of both objects."""
        corners = [0, GRID_POINTS - 1, -GRID_POINTS, -1]
        ends = self._features[corners] @ above
        middle = 0.5 * (self._start + ends.mean(axis=0))
        shares = np.linspace(0.08, 0.95, 15)

        def residual(posture: Array, i: int) -> Array:
            box = self._boxes[corners[i]]
            parts = []
            for between in interpolate_postures([self._start, posture, ends[i]], shares):
                pose = self._arm.pose(between)
                parts += [
                    shortfall(self._arm.clearances(pose, box).min(), PASSING_MARGIN_M),
                    self._clear_of_others(pose, PASSING_MARGIN_M),
                    self._table(pose, 0.01),
                    self._limits(between),
                ]
            return np.concatenate([*parts, (posture - middle) / (30 * ANGLE)])

        constant = np.ones((len(corners), 1))
        fitted = fit_polynomial(constant, residual, (middle + RAISED_RAD)[None], np.zeros(1))
        return np.asarray(fitted[0])


def _clearance_box(placed: PlacedObject) -> ClearanceBox:
    return ClearanceBox(np.array(placed.pose.position_m), np.array(placed.size_m), placed.yaw_rad)


def fit_key_postures() -> KeyPostures:
    """Fit all families; takes some minutes on one core."""
    return KeyPostures({family: FamilyFitter(family).fit() for family in FAMILIES})


def main() -> None:
    """Fit all key postures and write them where `load_key_postures` finds them."""
    write_postures(FITTED, fit_key_postures().to_json())


if __name__ == "__main__":
    main()
