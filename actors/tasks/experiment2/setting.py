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
from sim_assets.gestures.clip import Side

Kind = Literal["standing", "laying"]
Place = Literal["-0.15", "0.07"]
"""X of an object in the task frame (m), as text."""

KINDS: Final[tuple[Kind, ...]] = ("standing", "laying")
PLACES: Final[tuple[Place, ...]] = ("-0.15", "0.07")
SIZES_M: Final[Mapping[Kind, tuple[float, float, float]]] = {
    "standing": (0.028, 0.07, 0.15),
    "laying": (0.028, 0.15, 0.07),
}
"""Edge lengths of the two kinds of object (paper, section 4.3)."""
POINTED_SIDES: Final[Mapping[Place, Side]] = {"-0.15": "picture-right", "0.07": "picture-left"}
"""Where the person on the screen points for each place: the screen faces the robot, so the
picture's right is the robot's right."""

INDICATED: Final = "indicated_x_m"
SUBJECT: Final = "subject"
TAKE: Final = "take"


@dataclass(frozen=True)
class PlacedObject:
    """One of the two objects.

    Attributes:
        kind: how it is put up.
        place: its X.
        y_m: its Y.
        yaw_deg: its turn about the vertical.
    """

    kind: Kind
    place: Place
    y_m: float
    yaw_deg: float

    @classmethod
    def of(cls, situation: Mapping[str, float | str], place: Place) -> PlacedObject:
        """The object that a situation puts at a place."""
        return cls(
            kind=cast("Kind", situation[kind_name(place)]),
            place=place,
            y_m=float(situation[y_name(place)]),
            yaw_deg=float(situation[yaw_name(place)]),
        )

    @property
    def name(self) -> str:
        """What the object is called in the scene."""
        return f"object_at_{self.place}"

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
        target: the object at which the person points.
        other: the other object.
        subject: name of the person.
        take: name of the recording.
    """

    target: PlacedObject
    other: PlacedObject
    subject: str
    take: str

    @classmethod
    def of(cls, situation: Mapping[str, float | str]) -> Setting:
        """The setting that the values of a situation describe."""
        indicated = cast("Place", situation[INDICATED])
        other = next(place for place in PLACES if place != indicated)
        return cls(
            target=PlacedObject.of(situation, indicated),
            other=PlacedObject.of(situation, other),
            subject=str(situation[SUBJECT]),
            take=str(situation[TAKE]),
        )

    @property
    def objects(self) -> tuple[PlacedObject, PlacedObject]:
        """Both objects, in the order of PLACES."""
        first, second = sorted(
            (self.target, self.other), key=lambda placed: PLACES.index(placed.place)
        )
        return first, second

    @property
    def side(self) -> Side:
        """Where in the picture the person points."""
        return POINTED_SIDES[self.target.place]


def kind_name(place: Place) -> str:
    """Name of the value that says which kind of object is at a place."""
    return f"kind_at_{place}"


def y_name(place: Place) -> str:
    """Name of the value that says which Y the object at a place has."""
    return f"y_at_{place}_m"


def yaw_name(place: Place) -> str:
    """Name of the value that says how the object at a place is turned."""
    return f"yaw_at_{place}_deg"
