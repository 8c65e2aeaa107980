"""Fits the tutor's key postures of Experiment I and writes postures.json.

To be run once, with `python -m actors.tasks.experiment1.fitting`.

Each key posture is a polynomial of the situation. `actors.posture_fitting` fits its coefficients to
a grid of situations together. The residuals require the right pose of the hand, clearance from
obstacles and table, and angles within the joint limits.
"""

from __future__ import annotations

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
from actors.tasks.experiment1.postures import (
    FITTED,
    OBJECT_ORDERS,
    OBSTACLE_ORDERS,
    KeyPostures,
    object_features,
    obstacle_features,
)
from actors.tasks.experiment1.world import (
    OBJECT_SIZE_M,
    OBSTACLE_SIZE_M,
    START,
    TABLE_DROP_M,
    object_pose,
    obstacle_pose,
)
from proto.body import ARM
from proto.variables import Situation, number_of
from sim_assets.hand import APPROACH_AXIS, GRASP_AXIS, OPEN_DEG

Array = NDArray[np.float64]

OBJECT_MARGIN_M: Final = 0.006
TABLE_MARGIN_M: Final = 0.004
OBSTACLE_MARGIN_M: Final = 0.018
PASSING_MARGIN_M: Final = 0.016
DESCENT_M: Final = 0.085
LIFT_M: Final = 0.11
STEEPEST_APPROACH_RAD: Final = np.deg2rad(40.0)
NEAREST_OBSTACLE: Final[Situation] = {"obstacle_x_m": -0.22}
"""The obstacle's position nearest to the object, from which grasp and lift keep clear."""


class PostureFitter:
    """Fits the key postures one after another."""

    def __init__(self) -> None:
        """Make the model of the arm with the open hand, and the grids of situations."""
        self._arm = Arm(OPEN_DEG, TABLE_DROP_M)
        self._start = np.deg2rad(START[ARM])
        self._objects = [
            {"obstacle_x_m": -0.27, "object_y_m": float(y), "object_yaw_deg": float(yaw)}
            for y in np.linspace(0.20, 0.30, 5)
            for yaw in np.linspace(-45.0, 45.0, 9)
        ]
        self._obstacles = [
            {"obstacle_x_m": float(x), "object_y_m": 0.25, "object_yaw_deg": 0.0}
            for x in np.linspace(-0.32, -0.22, 5)
        ]
        self._object_features = np.array([object_features(s) for s in self._objects])
        self._obstacle_features = np.array([obstacle_features(s) for s in self._obstacles])

    def fit(self) -> KeyPostures:
        """Fit all key postures; takes a few seconds on one core."""
        grasp = self._fit_grasp()
        fitted = {"grasp": grasp}
        below = grasp
        for name, height in (
            ("down_2", DESCENT_M / 3),
            ("down_1", 2 * DESCENT_M / 3),
            ("above", DESCENT_M),
        ):
            below = fitted[name] = self._fit_descent(grasp, below, height)
        below = grasp
        for name, height in (("lift_1", LIFT_M / 2), ("lift_2", LIFT_M)):
            below = fitted[name] = self._fit_lift(grasp, below, height)
        over = self._fit_over(fitted["above"])
        beside = self._fit_beside(over)
        return KeyPostures(
            start=np.rad2deg(self._start),
            object={name: np.rad2deg(rows) for name, rows in fitted.items()},
            obstacle={"beside": np.rad2deg(beside), "over": np.rad2deg(over)},
        )

    def _limits(self, posture: Array) -> Array:
        return limit_violations(self._arm, posture)

    def _table(self, pose: ArmPose, margin: float = TABLE_MARGIN_M) -> Array:
        return shortfall(self._arm.heights(pose), margin)

    def _obstacle(self, pose: ArmPose, situation: Situation, margin: float) -> Array:
        return shortfall(self._arm.clearances(pose, _obstacle_box(situation)), margin)

    def _fit_grasp(self) -> Array:
        start = np.zeros((len(OBJECT_ORDERS), 7))
        start[0] = np.deg2rad([-5.0, 25.0, 45.0, 70.0, -35.0, -45.0, 8.0])
        centre = start[0].copy()

        def residual(posture: Array, i: int) -> Array:
            situation = self._objects[i]
            pose = self._arm.pose(posture)
            box = _object_box(situation)
            across, along = box.level_axes()
            offset = pose.grasp_centre_m - box.centre_m
            axis = pose.rotation @ GRASP_AXIS
            down = -(pose.rotation @ APPROACH_AXIS)[2]
            return np.concatenate(
                [
                    [offset @ across / POSITION, offset @ along / (2.5 * POSITION)],
                    [offset[2] / (3 * POSITION)],
                    [axis @ along / ANGLE, axis[2] / (4 * ANGLE)],
                    [max(0.0, np.cos(STEEPEST_APPROACH_RAD) - down) / (4 * ANGLE)],
                    shortfall(self._arm.clearances(pose, box), OBJECT_MARGIN_M),
                    self._table(pose),
                    self._obstacle(pose, NEAREST_OBSTACLE, OBSTACLE_MARGIN_M),
                    self._limits(posture),
                    (posture - centre) / (60 * ANGLE),
                ]
            )

        return fit_polynomial(self._object_features, residual, start, OBJECT_ORDERS)

    def _fit_descent(self, grasp: Array, below: Array, height_m: float) -> Array:
        """Fit a posture of the open hand at a height above the grasp, in the same orientation."""
        grasps = [self._arm.pose(q) for q in self._object_features @ grasp]
        before = self._object_features @ below
        loose = 1.0 + 4.0 * height_m / DESCENT_M

        def residual(posture: Array, i: int) -> Array:
            pose = self._arm.pose(posture)
            box = _object_box(self._objects[i])
            across, along = box.level_axes()
            target = box.centre_m + np.array([0.0, 0.0, height_m])
            offset = pose.grasp_centre_m - target
            axis = pose.rotation @ GRASP_AXIS
            turned = (pose.rotation @ APPROACH_AXIS) - grasps[i].rotation @ APPROACH_AXIS
            return np.concatenate(
                [
                    [offset @ across / (POSITION * loose), offset @ along / (2 * POSITION * loose)],
                    [offset[2] / (2 * POSITION * loose)],
                    [axis @ along / (ANGLE * loose), axis[2] / (4 * ANGLE * loose)],
                    turned / (3 * ANGLE * loose),
                    shortfall(self._arm.clearances(pose, box), OBJECT_MARGIN_M),
                    self._table(pose),
                    self._obstacle(pose, NEAREST_OBSTACLE, OBSTACLE_MARGIN_M),
                    self._limits(posture),
                    (posture - before[i]) / (15 * ANGLE),
                ]
            )

        return fit_polynomial(self._object_features, residual, below, OBJECT_ORDERS)

    def _fit_lift(self, grasp: Array, below: Array, height_m: float) -> Array:
        """Fit a posture that lifts the grasped object nearly level; it may shift sideways."""
        grasps = [self._arm.pose(q) for q in self._object_features @ grasp]
        before = self._object_features @ below

        def residual(posture: Array, i: int) -> Array:
            pose = self._arm.pose(posture)
            lift = np.array([0.0, 0.0, height_m])
            offset = pose.grasp_centre_m - grasps[i].grasp_centre_m - lift
            return np.concatenate(
                [
                    offset / [3 * LOOSE_POSITION, 3 * LOOSE_POSITION, 3 * POSITION],
                    ((pose.rotation - grasps[i].rotation) / (10 * ANGLE)).ravel(),
                    self._table(pose),
                    self._obstacle(pose, NEAREST_OBSTACLE, 2 * OBSTACLE_MARGIN_M),
                    self._limits(posture),
                    (posture - before[i]) / (10 * ANGLE),
                ]
            )

        return fit_polynomial(self._object_features, residual, below, OBJECT_ORDERS)

    def _fit_over(self, above: Array) -> Array:
        """Fit a posture of the hand just above the obstacle, from which the way on is clear."""
        middle = object_features(self._objects[len(self._objects) // 2]) @ above
        corners = [
            object_features({"object_y_m": y, "object_yaw_deg": yaw}) @ above
            for y in (0.20, 0.30)
            for yaw in (-45.0, 0.0, 45.0)
        ]
        start = np.zeros((len(OBSTACLE_ORDERS), 7))
        start[0] = middle
        raised = np.deg2rad([-10.0, 35.0, 0.0, 10.0, 0.0, 0.0, 0.0])
        start[0] += raised

        def residual(posture: Array, i: int) -> Array:
            situation = self._obstacles[i]
            box = _obstacle_box(situation)
            pose = self._arm.pose(posture)
            hand = pose.grasp_centre_m
            on_the_way = [
                self._obstacle(self._arm.pose(between), situation, PASSING_MARGIN_M)
                for corner in corners
                for between in interpolate_postures(
                    [posture, corner], np.array([0.1, 0.2, 0.35, 0.5, 0.75])
                )
            ]
            lowest = float(self._arm.heights(pose)[self._arm.of_hand].min())
            return np.concatenate(
                [
                    [(hand[0] - box.centre_m[0]) / LOOSE_POSITION],
                    [(hand[1] - 0.24) / (2 * LOOSE_POSITION)],
                    [(lowest - OBSTACLE_SIZE_M[2] - OBSTACLE_MARGIN_M) / (2 * POSITION)],
                    self._obstacle(pose, situation, OBSTACLE_MARGIN_M),
                    *on_the_way,
                    self._limits(posture),
                    (posture - middle) / (20 * ANGLE),
                ]
            )

        return fit_polynomial(self._obstacle_features, residual, start, OBSTACLE_ORDERS)

    def _fit_beside(self, over: Array) -> Array:
        """Fit a posture of the hand close to the right side of the obstacle, on its way up."""
        after = self._obstacle_features @ over

        def residual(posture: Array, i: int) -> Array:
            situation = self._obstacles[i]
            box = _obstacle_box(situation)
            pose = self._arm.pose(posture)
            hand = pose.grasp_centre_m
            leftmost = float((pose.points_m[:, 0] - self._arm.radii_m)[self._arm.of_hand].min())
            way = interpolate_postures(
                [self._start, posture, after[i]], np.linspace(0.05, 0.95, 19)
            )
            on_the_way = [
                part
                for between in way
                for part in (
                    self._obstacle(self._arm.pose(between), situation, PASSING_MARGIN_M),
                    self._limits(between),
                )
            ]
            return np.concatenate(
                [
                    [(leftmost - box.centre_m[0] - 0.005 - OBSTACLE_MARGIN_M) / (2 * POSITION)],
                    [(hand[1] - 0.24) / (3 * LOOSE_POSITION)],
                    [(hand[2] - 0.16) / LOOSE_POSITION],
                    self._obstacle(pose, situation, OBSTACLE_MARGIN_M),
                    *on_the_way,
                    self._table(pose, 0.02),
                    self._limits(posture),
                    (posture - 0.5 * (after[i] + self._start)) / (20 * ANGLE),
                ]
            )

        return fit_polynomial(self._obstacle_features, residual, over, OBSTACLE_ORDERS)


def _object_box(situation: Situation) -> ClearanceBox:
    pose = object_pose(situation)
    yaw = np.deg2rad(-number_of(situation, "object_yaw_deg"))
    return ClearanceBox(np.array(pose.position_m), np.array(OBJECT_SIZE_M), float(yaw))


def _obstacle_box(situation: Situation) -> ClearanceBox:
    return ClearanceBox(np.array(obstacle_pose(situation).position_m), np.array(OBSTACLE_SIZE_M))


def main() -> None:
    """Fit all key postures and write them to the file that `load_key_postures` reads."""
    write_postures(FITTED, PostureFitter().fit().to_json())


if __name__ == "__main__":
    main()
