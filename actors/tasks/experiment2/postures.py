"""Key postures of the tutor as polynomials of the object's position and yaw.

There are four families: each kind of object at each place is grasped in its own way.
`actors.tasks.experiment2.fitting` found the coefficients.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from actors.tasks.experiment2.setting import KINDS, PLACES, Kind, Place, PlacedObject
from actors.tasks.experiment2.world import Y_RANGE_M, YAW_RANGE_DEG

Array = NDArray[np.float64]
Family = tuple[Kind, Place]

FAMILIES: Final[tuple[Family, ...]] = tuple((kind, place) for kind in KINDS for place in PLACES)
POSTURES: Final = ("above", "approach_1", "approach_2", "grasp", "lift_1", "lift_2")
"""Postures that depend on where the object is and how it is turned."""

_POWERS: Final = tuple((y, yaw) for y in range(3) for yaw in range(3))
ORDERS: Final = np.array([a + b for a, b in _POWERS])


def features(y_m: float, yaw_deg: float) -> Array:
    """Monomials (9,) of an object's Y and yaw, both scaled to -1..1 over the ranges."""
    y = _scaled(y_m, Y_RANGE_M)
    yaw = _scaled(yaw_deg, YAW_RANGE_DEG)
    return np.array([y**a * yaw**b for a, b in _POWERS])


def _scaled(value: float, limits: tuple[float, float]) -> float:
    low, high = limits
    return (2.0 * value - low - high) / (high - low)


@dataclass(frozen=True)
class FamilyPostures:
    """The fitted key postures of one family.

    Attributes:
        passing: (7,) posture on the way from the start, clear of the other object, in degrees.
        at_object: coefficients (9, 7) in degrees of each posture in POSTURES.
    """

    passing: Array
    at_object: Mapping[str, Array]

    def arm_deg(self, name: str, placed: PlacedObject) -> Array:
        """Arm posture (7,) in degrees of a key posture for an object."""
        if name == "passing":
            return self.passing
        return np.asarray(features(placed.y_m, placed.yaw_deg) @ self.at_object[name])


@dataclass(frozen=True)
class KeyPostures:
    """The fitted key postures of Experiment II.

    Attributes:
        families: the postures of each family.
    """

    families: Mapping[Family, FamilyPostures]

    def for_object(self, placed: PlacedObject) -> FamilyPostures:
        """The postures of the family to which an object belongs."""
        return self.families[placed.kind, placed.place]

    def to_json(self) -> str:
        """Text from which `load_key_postures` reads the postures back."""
        values = [
            {
                "kind": kind,
                "place": place,
                "passing": family.passing.round(4).tolist(),
                "at_object": {
                    name: rows.round(4).tolist() for name, rows in family.at_object.items()
                },
            }
            for (kind, place), family in self.families.items()
        ]
        return json.dumps(values, indent=1) + "\n"


FITTED: Final = files("actors.tasks.experiment2").joinpath("postures.json")


@cache
def load_key_postures() -> KeyPostures:
    """The postures that were fitted once and lie beside this module; read once."""
    return KeyPostures(
        {(row["kind"], row["place"]): _family(row) for row in json.loads(FITTED.read_text())}
    )


def _family(row: Mapping[str, Any]) -> FamilyPostures:
    return FamilyPostures(
        passing=np.array(row["passing"]),
        at_object={name: np.array(row["at_object"][name]) for name in POSTURES},
    )
