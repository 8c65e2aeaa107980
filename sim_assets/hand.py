"""The iCub's right hand: nine motors, nineteen joints, capsule fingers.

Frame of the hand: the `r_hand_dh_frame` of the official model. x runs along the stretched fingers,
y towards the little finger, z out of the palm. Lengths are the iCub's own
(https://icub-tech-iit.github.io/documentation/icub_kinematics/icub-forward-kinematics-fingers/).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

FINGER_RADIUS_M: Final = 0.0065
PALM_SIZE_M: Final = (0.065, 0.069, 0.022)
"""Palm box along x, y, z of the hand frame."""
PALM_CENTRE_M: Final = (-0.027, 0.0, -0.013)


@dataclass(frozen=True)
class Motor:
    """One motor of the hand; its position is an angle in degrees.

    Attributes:
        name: the iCub's name for it.
        minimum_deg: lower limit.
        maximum_deg: upper limit.
    """

    name: str
    minimum_deg: float
    maximum_deg: float


@dataclass(frozen=True)
class Phalanx:
    """One joint of a finger and the link that it moves.

    The link is a capsule from the joint along the link's own x axis.

    Attributes:
        joint: name of the joint: that of the link with `_joint` at its end.
        parent: link that carries the joint.
        origin_m: position of the joint in the parent link (m).
        parent_yaw_deg: turn of the joint's frame about the parent's z axis.
        axis: axis of rotation in the joint's frame; a positive angle flexes.
        length_m: length of the link (m).
        motor: motor that drives the joint.
        gain: joint angle = offset_deg + gain * motor angle.
        offset_deg: joint angle when the motor is at zero.
    """

    joint: str
    parent: str
    origin_m: tuple[float, float, float]
    parent_yaw_deg: float
    axis: tuple[float, float, float]
    length_m: float
    motor: str
    gain: float
    offset_deg: float = 0.0

    @property
    def link(self) -> str:
        """Name of the link that the joint moves."""
        return self.joint.removesuffix("_joint")


MOTORS: Final = (
    Motor("hand_finger", 0.0, 60.0),
    Motor("thumb_oppose", 10.0, 90.0),
    Motor("thumb_proximal", 0.0, 90.0),
    Motor("thumb_distal", 0.0, 180.0),
    Motor("index_proximal", 0.0, 90.0),
    Motor("index_distal", 0.0, 180.0),
    Motor("middle_proximal", 0.0, 90.0),
    Motor("middle_distal", 0.0, 180.0),
    Motor("pinky", 0.0, 270.0),
)
MOTOR_NAMES: Final = tuple(motor.name for motor in MOTORS)

_FLEX: Final = (0.0, -1.0, 0.0)  # turns x towards z, the palm side


def _finger(
    name: str,
    base_m: tuple[float, float, float],
    knuckle_m: float,
    lengths_m: tuple[float, float, float],
    motors: tuple[str, str, str],
    gains: tuple[float, float, float],
    spread: float,
) -> tuple[Phalanx, ...]:
    """A finger of three phalanges, with a joint before them that spreads it sideways, or without.

    `spread` is 0 without that joint, else the sign of its angle when the fingers are spread.
    """
    links: list[Phalanx] = []
    parent, place = "r_hand_dh_frame", base_m
    if spread:
        # At hand_finger 60 the fingers are parallel, at 0 each is spread by 20 degrees.
        links.append(
            Phalanx(
                f"r_{name}_0_joint", parent, base_m, 0.0, (0.0, 0.0, 1.0), knuckle_m,
                "hand_finger", -spread / 3.0, spread * 20.0,
            )
        )  # fmt: skip
        parent, place = f"r_{name}_0", (knuckle_m, 0.0, 0.0)
    for number, (length, motor, gain) in enumerate(zip(lengths_m, motors, gains, strict=True), 1):
        joint = f"r_{name}_{number}_joint"
        links.append(Phalanx(joint, parent, place, 0.0, _FLEX, length, motor, gain))
        parent, place = f"r_{name}_{number}", (length, 0.0, 0.0)
    return tuple(links)


_THUMB: Final = (
    # At oppose 0 the thumb points to the index side, at 90 out of the palm.
    Phalanx(
        "r_thumb_0_joint", "r_hand_dh_frame", (-0.0240, -0.0119, -0.0017), -90.0,
        (0.0, -1.0, 0.0), 0.0210, "thumb_oppose", 1.0,
    ),
    Phalanx(
        "r_thumb_1_joint", "r_thumb_0", (0.0210, 0.0, 0.0), 0.0,
        (0.0, 0.0, 1.0), 0.0260, "thumb_proximal", 1.0,
    ),
    Phalanx(
        "r_thumb_2_joint", "r_thumb_1", (0.0260, 0.0, 0.0), 0.0,
        (0.0, 0.0, 1.0), 0.0220, "thumb_distal", 0.5,
    ),
    Phalanx(
        "r_thumb_3_joint", "r_thumb_2", (0.0220, 0.0, 0.0), 0.0,
        (0.0, 0.0, 1.0), 0.0168, "thumb_distal", 0.5,
    ),
)  # fmt: skip

_INDEX_MOTORS: Final = ("index_proximal", "index_distal", "index_distal")
_MIDDLE_MOTORS: Final = ("middle_proximal", "middle_distal", "middle_distal")
_PINKY: Final = ("pinky", "pinky", "pinky")
_HALVES: Final = (1.0, 0.5, 0.5)
_THIRDS: Final = (1 / 3, 1 / 3, 1 / 3)

PHALANGES: Final[tuple[Phalanx, ...]] = (
    *_THUMB,
    *_finger("index", (0.0025, -0.0253, -0.0110), 0.0148, (0.0259, 0.0220, 0.0168),
             _INDEX_MOTORS, _HALVES, -1.0),
    *_finger("middle", (0.0178, -0.0083, -0.0118), 0.0, (0.0285, 0.0240, 0.0168),
             _MIDDLE_MOTORS, _HALVES, 0.0),
    *_finger("ring", (0.0016, 0.0072, -0.0115), 0.0148, (0.0259, 0.0220, 0.0168),
             _PINKY, _THIRDS, 1.0),
    *_finger("little", (-0.0004, 0.0233, -0.0096), 0.0148, (0.0219, 0.0190, 0.0168),
             _PINKY, _THIRDS, 1.0),
)  # fmt: skip

_COUPLING: Final = np.array(
    [[p.gain if p.motor == name else 0.0 for name in MOTOR_NAMES] for p in PHALANGES]
)
_OFFSET_DEG: Final = np.array([p.offset_deg for p in PHALANGES])
_DECOUPLING: Final = np.linalg.pinv(_COUPLING)

OPEN_DEG: Final = np.array([60.0, 85.0, 42.0, 50.0, 0.0, 10.0, 0.0, 10.0, 10.0])
"""Motor angles at grasp level 1: the hand is open somewhat wider than the object."""
CLOSED_DEG: Final = np.array([60.0, 85.0, 62.0, 64.0, 38.0, 36.0, 38.0, 36.0, 75.0])
"""Motor angles at grasp level 10; an object in the hand stops the fingers before that."""

_PINCH_TILT: Final = np.deg2rad(75.0)
GRASP_AXIS: Final = np.array([np.cos(_PINCH_TILT), 0.0, -np.sin(_PINCH_TILT)])
"""Unit vector in the hand frame from the thumb to the fingers that oppose it."""
APPROACH_AXIS: Final = np.array([np.sin(_PINCH_TILT), 0.0, np.cos(_PINCH_TILT)])
"""Unit vector in the hand frame along which the open hand slides over an object."""
GRASP_CENTRE_M: Final = -0.006 * GRASP_AXIS + 0.060 * APPROACH_AXIS + np.array([0.0, -0.012, 0.0])
"""Where a grasped object's centre lies in the hand frame: midway between thumb and fingers."""


def motors_from_grasp(level: float) -> NDArray[np.float64]:
    """Motor angles (9,) in degrees for a grasp level from 1 (open) to 10 (closed), linear."""
    fraction = (np.clip(level, 1.0, 10.0) - 1.0) / 9.0
    return np.asarray(OPEN_DEG + (CLOSED_DEG - OPEN_DEG) * fraction, dtype=np.float64)


def closing_fraction(motors_deg: NDArray[np.float64]) -> float:
    """How far the hand is closed, 0 (open) to 1 (closed): least squares over motor angles (9,)."""
    stroke = CLOSED_DEG - OPEN_DEG
    return float(stroke @ (motors_deg - OPEN_DEG) / (stroke @ stroke))


def joints_from_motors(motors_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Joint angles (..., 19) in degrees, in the order of PHALANGES, for motor angles (..., 9)."""
    return np.asarray(_OFFSET_DEG + motors_deg @ _COUPLING.T, dtype=np.float64)


def motors_from_joints(joints_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Motor angles (9,) in degrees that fit joint angles (19,) best."""
    return np.asarray(_DECOUPLING @ (joints_deg - _OFFSET_DEG), dtype=np.float64)
