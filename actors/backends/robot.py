"""The robot as every backend builds and drives it: joints, drives, friction, and where it stands.

Angles of joints are in the order of `IcubModel.joints`: neck (2), right arm (7), phalanges (19).
Angles of motors are in the order of `Observation.joints_deg`: neck (2), arm (7), hand motors (9).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from actors.simulator import Array, JointTargets, Pose
from proto.cache import cache_folder
from proto.errors import UserError
from sim_assets.hand import PHALANGES, joints_from_motors, motors_from_joints
from sim_assets.icub import ARM_JOINTS, NECK_JOINTS, IcubModel, build_icub

MOTOR_COUNT: Final = 18
_BEFORE_HAND: Final = len(NECK_JOINTS) + len(ARM_JOINTS)

SKIN_FRICTION: Final = 1.0
"""Coulomb friction of the robot's skin; between two bodies the mean of both frictions counts."""
STATIC_LINKS: Final = frozenset({"root_link", "torso_1", "torso_2", "chest"})
"""Links that never move; `Simulator.bodies` leaves them out."""
ROOT_QUATERNION: Final = (float(np.sqrt(0.5)), 0.0, 0.0, -float(np.sqrt(0.5)))
"""Turn (w first) of the root frame (x back, y right, z up) in the world (x right, y forward)."""


@dataclass(frozen=True)
class Drive:
    """A joint's position drive: torque = stiffness * angle error - damping * speed.

    Attributes:
        stiffness: Nm/rad.
        damping: Nm s/rad.
        torque_limit: greatest torque (Nm).
        armature: inertia of the motor at the joint (kg m^2).
    """

    stiffness: float
    damping: float
    torque_limit: float
    armature: float = 0.0


_ARM_DRIVE: Final = Drive(400.0, 40.0, 60.0, armature=0.02)
_NECK_DRIVE: Final = Drive(100.0, 10.0, 20.0)
_FINGER_DRIVE: Final = Drive(3.0, 0.08, 0.6, armature=1e-5)


def drive_of(joint: str) -> Drive:
    """The drive of a joint of the robot, by the joint's name."""
    if joint in ARM_JOINTS:
        return _ARM_DRIVE
    return _NECK_DRIVE if joint in NECK_JOINTS else _FINGER_DRIVE


def build_robot() -> IcubModel:
    """The robot's model, built or from the cache folder.

    Raises:
        UserError: it can neither be read nor built; the message says what to do.
    """
    try:
        return build_icub(cache_folder())
    except OSError as error:
        raise UserError(
            f"the robot's model cannot be built: {error}. Set VMDNN_CACHE to a folder that can be"
            " written; if a file of icub-models is missing, install that package again."
        ) from error


def motors_of(targets: JointTargets) -> Array:
    """Motor angles (18,) in degrees of joint targets."""
    return np.concatenate([targets.neck_deg, targets.arm_deg, targets.hand_deg])


def motor_ramp_deg(before: Array, after: Array, steps: int) -> Array:
    """Motor angles (steps, 18) on the straight line from `before`, excluded, to `after`."""
    return np.linspace(before, after, steps + 1)[1:]


def joints_from_motors_rad(motors_deg: Array) -> Array:
    """Angles (..., 28) of all joints, in radians, for motor angles (..., 18) in degrees."""
    hand_deg = joints_from_motors(motors_deg[..., _BEFORE_HAND:])
    joints_deg = np.concatenate([motors_deg[..., :_BEFORE_HAND], hand_deg], axis=-1)
    return np.asarray(np.deg2rad(joints_deg), dtype=np.float64)


def recorded_joints_rad(joints_deg: Array, bodies: Mapping[str, Pose]) -> Array:
    """Angles (28,) of all joints, in radians, of a recorded state.

    Fingers that hold something differ from what the angles of their motors say. Where the poses of
    their links are known, their angles follow from these.

    Args:
        joints_deg: (18,) motor angles in degrees.
        bodies: poses of bodies by name.
    """
    joints_rad = joints_from_motors_rad(joints_deg)
    for place, phalanx in enumerate(PHALANGES, _BEFORE_HAND):
        if {phalanx.parent, phalanx.link} <= bodies.keys():
            before = _rotation(bodies[phalanx.parent]) * Rotation.from_euler(
                "z", phalanx.parent_yaw_deg, degrees=True
            )
            turn = before.inv() * _rotation(bodies[phalanx.link])
            joints_rad[place] = turn.as_rotvec() @ np.array(phalanx.axis)
    return joints_rad


def _rotation(pose: Pose) -> Rotation:
    return Rotation.from_quat(pose.quaternion, scalar_first=True)


def motors_from_joints_deg(joints_rad: Array) -> Array:
    """Motor angles (18,) in degrees that fit angles (28,) of all joints, in radians, best."""
    angles_deg = np.rad2deg(joints_rad)
    hand_deg = motors_from_joints(angles_deg[_BEFORE_HAND:])
    return np.concatenate([angles_deg[:_BEFORE_HAND], hand_deg])
