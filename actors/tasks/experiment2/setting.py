"""A situation of Experiment II with types, and the poses that follow from it.

Task frame of the paper: X lateral (negative is the robot's right), Y forward, Z up, left-handed.
The paper calls the places left and right without saying from whose side, so here each is named by
its X.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal, cast

import numpy as np

from actors.simulator import Pose
from proto.variables import Situation, number_of
from sim_assets.gestures.clip import Side

Kind = Literal["standing", "laying"]
Place = Literal["-0.15", "0.07"]
"""X of an object in the task frame (m), as text."""
Role = Literal["indicated", "other"]
"""Whether the person points at an object."""

KINDS: Final[tuple[Kind, ...]] = ("standing", "laying")
PLACES: Final[tuple[Place, ...]] = ("-0.15", "0.07")
ROLES: Final[tuple[Role, ...]] = ("indicated", "other")
SIZES_M: Final[Mapping[Kind, tuple[float, float, float]]] = {
    "standing": (0.028, 0.07, 0.15),
    "laying": (0.028, 0.15, 0.07),
}
"""Edge lengths of the two kinds of object (paper, section 4.3)."""
POINTED_SIDES: Final[Mapping[Place, Side]] = {"-0.15": "picture-right", "0.07": "picture-left"}
"""Where the person on the screen points for each place: the screen faces the robot, so the
picture's right is the robot's right."""

INDICATED_X: Final = "indicated_x_m"
SUBJECT: Final = "subject"
TAKE: Final = "take"


@dataclass(frozen=True)
class PlacedObject:
    """One of the two objects.

    Attributes:
        role: which of the two it is.
        kind: how it is put up.
        place: its X.
        y_m: its Y.
        yaw_deg: its turn about the vertical.
    """

    role: Role
    kind: Kind
    place: Place
    y_m: float
    yaw_deg: float

    @property
    def name(self) -> str:
        """What the object is called in the scene."""
        return f"{self.role}_object"

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Edge lengths along its own x, y, z (m)."""
        return SIZES_M[self.kind]

    @property
    def yaw_rad(self) -> float:
        """Turn about the vertical in the world frame."""
        return float(np.deg2rad(-self.yaw_deg))

    @property
    def pose(self) -> Pose:
        """Where it starts, in the world frame."""
        half = self.yaw_rad / 2
        return Pose(
            (-float(self.place), self.y_m, self.size_m[2] / 2),
            (float(np.cos(half)), 0.0, 0.0, float(np.sin(half))),
        )


@dataclass(frozen=True)
class Setting:
    """A situation of Experiment II.

    Attributes:
        indicated: the object at which the person points.
        other: the other object.
        subject: name of the person.
        take: name of the recording.
    """

    indicated: PlacedObject
    other: PlacedObject
    subject: str
    take: str

    @classmethod
    def of(cls, situation: Situation) -> Setting:
        """The setting that the values of a situation describe."""
        place = cast("Place", situation[INDICATED_X])
        return cls(
            indicated=_placed(situation, "indicated", place),
            other=_placed(situation, "other", other_place(place)),
            subject=str(situation[SUBJECT]),
            take=str(situation[TAKE]),
        )

    @property
    def side(self) -> Side:
        """Where in the picture the person points."""
        return POINTED_SIDES[self.indicated.place]


def variable_name(role: Role, value: Literal["kind", "y_m", "yaw_deg"]) -> str:
    """Name of the variable that holds a value of one of the objects."""
    return f"{role}_{value}"


def other_place(place: Place) -> Place:
    """The place where the other object is."""
    return next(each for each in PLACES if each != place)


def _placed(situation: Situation, role: Role, place: Place) -> PlacedObject:
    return PlacedObject(
        role=role,
        kind=cast("Kind", situation[variable_name(role, "kind")]),
        place=place,
        y_m=number_of(situation, variable_name(role, "y_m")),
        yaw_deg=number_of(situation, variable_name(role, "yaw_deg")),
    )
