"""Disturbances of an episode by name, with the strengths that they may have.

What they do is in `actors/disturbances/`. This table is here because configurations and messages
name disturbances, and are checked against it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final


class Ability(StrEnum):
    """What a simulator must be able to do for some disturbances; each is a field of `Scene`.

    shoves: an outside hand moves a box during the episode.
    knocks: an outside torque acts on a joint during the episode.
    damping: a joint's drive has another damping.
    eye_turn: the eye's camera is mounted with a turn.
    """

    SHOVES = "shoves"
    KNOCKS = "knocks"
    DAMPING = "damping"
    EYE_TURN = "eye_turn"


@dataclass(frozen=True)
class Disturbance:
    """A disturbance that an episode can have.

    Attributes:
        what: what it does, for people.
        unit: unit of its strength.
        least: smallest strength.
        most: largest strength.
        usual: range of strengths where none is given.
        ability: what the simulator must be able to do; None if every simulator can play it.
    """

    what: str
    unit: str
    least: float
    most: float
    usual: tuple[float, float]
    ability: Ability | None = None

    def problem(self, strength: float) -> str:
        """Why a strength is not allowed; empty if it is."""
        if self.least <= strength <= self.most:
            return ""
        return (
            f"a strength of {strength:g} lies outside {self.least:g} .. {self.most:g} {self.unit}"
        )


DISTURBANCES: Final[Mapping[str, Disturbance]] = {
    "pushed": Disturbance(
        "the object is pushed along Y before the hand comes down",
        *("mm", 1.0, 50.0, (10.0, 30.0), Ability.SHOVES),
    ),
    "turned": Disturbance(
        "the object is turned about the vertical before the hand comes down",
        *("degrees", 1.0, 45.0, (10.0, 20.0), Ability.SHOVES),
    ),
    "knocked": Disturbance(
        "a torque acts on a joint of the arm for 0.3 s",
        *("Nm", 1.0, 60.0, (10.0, 30.0), Ability.KNOCKS),
    ),
    "joint-friction": Disturbance(
        "the damping of a joint of the arm is so many times as large",
        *("times", 1.1, 5.0, (2.0, 2.0), Ability.DAMPING),
    ),
    "camera-turned": Disturbance(
        "the eye's camera is mounted with a turn about any axis",
        *("degrees", 0.1, 10.0, (0.5, 2.0), Ability.EYE_TURN),
    ),
    "brighter": Disturbance("all grey levels are higher", "%", 1.0, 100.0, (10.0, 30.0)),
    "darker": Disturbance("all grey levels are lower", "%", 1.0, 90.0, (10.0, 30.0)),
    "noisy": Disturbance(
        "each pixel has noise of this standard deviation", "grey levels", 0.5, 60.0, (5.0, 15.0)
    ),
    "blurred": Disturbance(
        "a Gaussian blur of this standard deviation", "pixels", 0.2, 5.0, (0.5, 1.5)
    ),
    "occluded": Disturbance(
        "a black square of this width hides a part of the picture",
        "pixels",
        1.0,
        30.0,
        (10.0, 10.0),
    ),
    "table-shade": Disturbance(
        "the table is lighter or darker by this share", "%", 1.0, 80.0, (20.0, 40.0)
    ),
    "larger": Disturbance(
        "width and depth of the object are larger; its height stays", "%", 1.0, 30.0, (10.0, 10.0)
    ),
    "heavier": Disturbance("the object's mass is larger", "%", 1.0, 900.0, (10.0, 10.0)),
    "slippery": Disturbance("the object's friction is smaller", "%", 1.0, 95.0, (10.0, 10.0)),
}
"""All disturbances by name."""
