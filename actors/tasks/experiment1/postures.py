"""Key postures of the tutor as polynomials of the situation.

Each key posture is a low-order polynomial of the variables that it depends on, so that neighbouring
situations have similar trajectories. `actors.tasks.experiment1.fitting` fits the coefficients.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Final

import numpy as np
from numpy.typing import NDArray

from proto.variables import Situation, number_of

Array = NDArray[np.float64]

OBJECT_POSTURES: Final = ("above", "down_1", "down_2", "grasp", "lift_1", "lift_2")
"""Postures that depend on the position and yaw of the object."""
OBSTACLE_POSTURES: Final = ("beside", "over")
"""Postures that depend on the position of the obstacle."""

_OBJECT_POWERS: Final = tuple((y, yaw) for y in range(3) for yaw in range(4))
_OBSTACLE_POWERS: Final = (0, 1, 2)


def object_features(situation: Situation) -> Array:
    """Return the monomials (12,) of the object's Y and yaw, both scaled to -1..1."""
    y = (number_of(situation, "object_y_m") - 0.25) / 0.05
    yaw = number_of(situation, "object_yaw_deg") / 45.0
    return np.array([y**a * yaw**b for a, b in _OBJECT_POWERS])


def obstacle_features(situation: Situation) -> Array:
    """Return the monomials (3,) of the obstacle's X, scaled to -1..1."""
    x = (number_of(situation, "obstacle_x_m") + 0.27) / 0.05
    return np.array([x**power for power in _OBSTACLE_POWERS])


OBJECT_ORDERS: Final = np.array([a + b for a, b in _OBJECT_POWERS])
OBSTACLE_ORDERS: Final = np.array(_OBSTACLE_POWERS)


@dataclass(frozen=True)
class KeyPostures:
    """The fitted key postures of Experiment I.

    Attributes:
        start: (7,) arm posture that every episode starts from, in degrees.
        object: coefficients (12, 7) in degrees of each posture in OBJECT_POSTURES.
        obstacle: coefficients (3, 7) in degrees of each posture in OBSTACLE_POSTURES.
    """

    start: Array
    object: dict[str, Array]
    obstacle: dict[str, Array]

    def arm_deg(self, name: str, situation: Situation) -> Array:
        """Return the arm angles (7,) of a key posture in a situation (degrees)."""
        if name in self.object:
            return np.asarray(object_features(situation) @ self.object[name])
        return np.asarray(obstacle_features(situation) @ self.obstacle[name])

    def to_json(self) -> str:
        """Return the postures as JSON, as `load_key_postures` reads it."""
        values = {
            "start": self.start.round(4).tolist(),
            "object": {name: rows.round(4).tolist() for name, rows in self.object.items()},
            "obstacle": {name: rows.round(4).tolist() for name, rows in self.obstacle.items()},
        }
        return json.dumps(values, indent=1) + "\n"


FITTED: Final = files("actors.tasks.experiment1").joinpath("postures.json")


@cache
def load_key_postures() -> KeyPostures:
    """Return the fitted postures; the file is read only once."""
    values = json.loads(FITTED.read_text())
    return KeyPostures(
        start=np.array(values["start"]),
        object={name: np.array(values["object"][name]) for name in OBJECT_POSTURES},
        obstacle={name: np.array(values["obstacle"][name]) for name in OBSTACLE_POSTURES},
    )
