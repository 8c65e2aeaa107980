"""A person who points, the room and the camera: all that stays the same between takes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SUBJECT_STREAM = 7
"""First word of the seed of every subject."""


class Sleeve(Enum):
    """Where the sleeves end."""

    SHORT = "above the elbow"
    HALF = "below the elbow"
    LONG = "at the wrist"


@dataclass(frozen=True)
class Subject:
    """One person in front of a wall. Grey levels are 0 (black) .. 255 (white).

    Clothes, skin and hair are always darker than the wall. V_F has three maps, and a network that
    was trained on few subjects recognizes new ones only if the contrast has the same sign.

    Attributes:
        seed: what the subject was drawn from; takes depend on it too.
        height_m: body height.
        girth: thickness of trunk and limbs, 1 on average.
        skin, hair, shirt, trousers: grey levels.
        sleeve: where the sleeves end.
        long_hair: whether the hair falls to the shoulders.
        shadow: brightness of the edges of limbs relative to their middle, 0..1.
        wall: grey level of the middle of the wall.
        wall_slope: difference in grey between the wall's right edge and its middle.
        camera_m: (3,) position of the camera; x to the picture's right, y up from the floor, z
            from the wall towards the camera. The subject stands near x = z = 0.
    """

    seed: int
    height_m: float
    girth: float
    skin: float
    hair: float
    shirt: float
    trousers: float
    sleeve: Sleeve
    long_hair: bool
    shadow: float
    wall: float
    wall_slope: float
    camera_m: Array

    @classmethod
    def from_seed(cls, seed: int) -> Subject:
        """Draw a subject; the same seed gives the same subject."""
        random = np.random.default_rng([_SUBJECT_STREAM, seed])
        return cls(
            seed=seed,
            height_m=random.uniform(1.55, 1.92),
            girth=random.uniform(0.85, 1.25),
            skin=random.uniform(50.0, 115.0),
            hair=random.uniform(10.0, 90.0),
            shirt=random.uniform(20.0, 95.0),
            trousers=random.uniform(20.0, 120.0),
            sleeve=tuple(Sleeve)[random.integers(len(Sleeve))],
            long_hair=bool(random.random() < 0.4),
            shadow=random.uniform(0.6, 1.0),
            wall=random.uniform(150.0, 215.0),
            wall_slope=random.normal(0.0, 6.0),
            camera_m=random.normal([0.0, 1.25, 2.7], [0.08, 0.05, 0.12]),
        )
