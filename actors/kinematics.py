"""Forward kinematics of the right arm, its clearance from boxes, and gaze angles.

All positions are in the world frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.optimize import least_squares

from proto.cache import cache_folder
from sim_assets.hand import GRASP_CENTRE_M, PHALANGES, joints_from_motors
from sim_assets.icub import (
    ARM_JOINTS,
    EYE,
    HAND,
    JOINT_LIMITS_DEG,
    NECK_JOINTS,
    Capsule,
    Collider,
    build_icub,
)

Array = NDArray[np.float64]

# Root frame of the iCub: x back, y right, z up. World: x right, y forward, z up.
_ROOT_IN_WORLD: Final = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class ClearanceBox:
    """A box whose distance to the arm is measured.

    Attributes:
        centre_m: (3,) centre in the world frame.
        size_m: (3,) full edge lengths.
        yaw_rad: rotation about the vertical.
    """

    centre_m: Array
    size_m: Array
    yaw_rad: float = 0.0

    def level_axes(self) -> tuple[Array, Array]:
        """Return the box's horizontal axes x and y as unit vectors (3,), (3,)."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([c, s, 0.0]), np.array([-s, c, 0.0])

    def distance(self, points: Array) -> Array:
        """Return the signed distances (N,) of points (N, 3) from the surface (m).

        A distance is negative inside the box.
        """
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        local = (points - self.centre_m) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        beyond = np.abs(local) - np.asarray(self.size_m) / 2
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))


@dataclass(frozen=True)
class ArmPose:
    """Pose of the hand and position of the arm's collision points in one posture.

    Attributes:
        rotation: (3, 3) rotation of the hand frame.
        position_m: (3,) origin of the hand frame.
        points_m: (N, 3) centres of the spheres that approximate the colliders.
    """

    rotation: Array
    position_m: Array
    points_m: Array

    @property
    def grasp_centre_m(self) -> Array:
        """Grasp centre (3,) of the hand."""
        return np.asarray(self.rotation @ GRASP_CENTRE_M + self.position_m)


class Arm:
    """Kinematic model of the right arm with fixed hand motors.

    Spheres along the axes of the colliders approximate the arm for clearances.

    Attributes:
        minimum_rad: (7,) lower joint limits.
        maximum_rad: (7,) upper joint limits.
        radii_m: (N,) radii of the spheres.
        of_hand: (N,) whether a sphere belongs to palm and fingers; the others belong to the arm.
    """

    def __init__(self, motors_deg: Array, table_drop_m: float) -> None:
        """Build the model, in which only the arm's seven joints move.

        Args:
            motors_deg: (9,) angles of the hand motors.
            table_drop_m: height of the root link above the table top (world z = 0).
        """
        model = build_icub(cache_folder())
        full = pin.buildModelFromUrdf(str(model.urdf))
        posture = pin.neutral(full)
        angles = np.deg2rad(joints_from_motors(motors_deg))
        for phalanx, angle in zip(PHALANGES, angles, strict=True):
            posture[full.joints[full.getJointId(phalanx.joint)].idx_q] = angle
        moving = {full.getJointId(name) for name in ARM_JOINTS}
        frozen = [joint for joint in range(1, full.njoints) if joint not in moving]
        self._model = pin.buildReducedModel(full, frozen, posture)
        self._data = self._model.createData()
        self._offset_m = np.array([0.0, 0.0, table_drop_m])
        self._hand = self._model.getFrameId(HAND)
        self._clouds = self._collider_clouds(model.colliders)
        limits = np.deg2rad([JOINT_LIMITS_DEG[name] for name in ARM_JOINTS])
        self.minimum_rad: Array = limits[:, 0]
        self.maximum_rad: Array = limits[:, 1]
        self.radii_m = np.concatenate([cloud[2] for cloud in self._clouds])
        self.of_hand = np.concatenate(
            [np.full(len(cloud[2]), cloud[0] == self._model.njoints - 1) for cloud in self._clouds]
        )

    def _collider_clouds(self, colliders: tuple[Collider, ...]) -> list[tuple[int, Array, Array]]:
        """Return points of each moving joint's colliders, in its frame, and their radii."""
        clouds = []
        framed = [
            (self._model.frames[self._model.getFrameId(collider.link)], collider)
            for collider in colliders
        ]
        for joint, parts in groupby(framed, lambda part: part[0].parentJoint):
            points, radii = [], []
            for frame, collider in parts:
                sampled, radius = _sample(collider)
                points.append(sampled @ frame.placement.rotation.T + frame.placement.translation)
                radii.append(np.full(len(sampled), radius))
            clouds.append((joint, np.concatenate(points), np.concatenate(radii)))
        return clouds

    def pose(self, posture_rad: Array) -> ArmPose:
        """Compute the forward kinematics of joint angles (7,) in radians."""
        pin.forwardKinematics(self._model, self._data, posture_rad)
        hand = pin.updateFramePlacement(self._model, self._data, self._hand)
        points = np.concatenate(
            [
                cloud @ self._data.oMi[joint].rotation.T + self._data.oMi[joint].translation
                for joint, cloud, _ in self._clouds
            ]
        )
        return ArmPose(
            rotation=_ROOT_IN_WORLD @ hand.rotation,
            position_m=_ROOT_IN_WORLD @ hand.translation + self._offset_m,
            points_m=points @ _ROOT_IN_WORLD.T + self._offset_m,
        )

    def clearances(self, pose: ArmPose, box: ClearanceBox) -> Array:
        """Return the distances (N,) of the spheres from a box; negative inside (m)."""
        return np.asarray(box.distance(pose.points_m) - self.radii_m)

    def heights(self, pose: ArmPose) -> Array:
        """Return the distances (N,) of the spheres above the table top; negative below (m)."""
        return np.asarray(pose.points_m[:, 2] - self.radii_m)


def _sample(collider: Collider, spacing_m: float = 0.015) -> tuple[Array, float]:
    """Approximate a collider by spheres; return their centres (N, 3) and their radius.

    The centres lie on the axis of a capsule, or on a grid inside a box.
    """
    if isinstance(collider, Capsule):
        start, end = np.array(collider.start_m), np.array(collider.end_m)
        count = 2 + int(np.linalg.norm(end - start) / spacing_m)
        return start + np.linspace(0.0, 1.0, count)[:, None] * (end - start), collider.radius_m
    half = np.array(collider.size_m) / 2
    radius = float(half.min())
    grid = [np.linspace(-h, h, 2 + int(2 * h / 0.02)) for h in half - radius]
    return np.array(collider.centre_m) + np.stack(np.meshgrid(*grid), -1).reshape(-1, 3), radius


class Gaze:
    """Kinematic model of the neck and the left eye."""

    def __init__(self, table_drop_m: float) -> None:
        """Build the model, in which only the neck's two joints move.

        Args:
            table_drop_m: height of the root link above the table top (world z = 0).
        """
        full = pin.buildModelFromUrdf(str(build_icub(cache_folder()).urdf))
        moving = {full.getJointId(name) for name in NECK_JOINTS}
        frozen = [joint for joint in range(1, full.njoints) if joint not in moving]
        self._model = pin.buildReducedModel(full, frozen, pin.neutral(full))
        self._data = self._model.createData()
        self._eye = self._model.getFrameId(EYE)
        self._offset_m = np.array([0.0, 0.0, table_drop_m])
        self._limits = np.deg2rad([JOINT_LIMITS_DEG[name] for name in NECK_JOINTS]).T

    def neck_deg(self, point_m: Array) -> Array:
        """Return neck pitch and yaw (2,) in degrees that centre a point (3,) in the eye image.

        If the neck cannot reach such angles, the angles bring the point as near to the centre as
        possible.
        """

        def off_axis(neck_rad: Array) -> Array:
            pin.forwardKinematics(self._model, self._data, neck_rad)
            eye = pin.updateFramePlacement(self._model, self._data, self._eye)
            seen = eye.actInv(_ROOT_IN_WORLD.T @ (point_m - self._offset_m))
            return np.asarray(seen[1:] / np.linalg.norm(seen))

        solution = least_squares(off_axis, np.zeros(2), bounds=self._limits)
        return np.asarray(np.rad2deg(solution.x))
