"""The eleven analog values that M_O codes (paper, section 4.1), in their fixed order.

An *action* is a float array of shape (11,): the command to the robot for the next control step.
Angles are in degrees; levels have no unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class ActionValue:
    """One analog value of the action.

    Attributes:
        name: its name in files, messages and plots.
        minimum: lowest value the robot accepts (degrees, or a level).
        maximum: highest value the robot accepts (degrees, or a level).
    """

    name: str
    minimum: float
    maximum: float


# Joint limits are those of the iCub simulator that the paper used.
ACTION_VALUES: Final[tuple[ActionValue, ...]] = (
    ActionValue("neck_pitch", -40.0, 30.0),
    ActionValue("neck_yaw", -55.0, 55.0),
    ActionValue("r_shoulder_pitch", -95.0, 10.0),
    ActionValue("r_shoulder_roll", 0.0, 160.8),
    ActionValue("r_shoulder_yaw", -37.0, 80.0),
    ActionValue("r_elbow", 15.5, 106.0),
    ActionValue("r_wrist_prosup", -90.0, 90.0),
    ActionValue("r_wrist_pitch", -90.0, 0.0),
    ActionValue("r_wrist_yaw", -20.0, 40.0),
    ActionValue("grasp_level", 1.0, 10.0),
    ActionValue("focus_level", 1.0, 20.0),
)
ACTION_NAMES: Final[tuple[str, ...]] = tuple(value.name for value in ACTION_VALUES)
ACTION_SIZE: Final = len(ACTION_VALUES)

NECK: Final = slice(0, 2)
ARM: Final = slice(2, 9)
GRASP: Final = 9
FOCUS: Final = 10

JOINT_NAMES: Final[tuple[str, ...]] = (
    *ACTION_NAMES[NECK],
    *ACTION_NAMES[ARM],
    "hand_finger",
    "thumb_oppose",
    "thumb_proximal",
    "thumb_distal",
    "index_proximal",
    "index_distal",
    "middle_proximal",
    "middle_distal",
    "pinky",
)
"""The measured joints, in the order of an episode's `joints_deg`: neck, arm, hand motors."""

IMAGE_HEIGHT: Final = 48
IMAGE_WIDTH: Final = 64
