"""Baselines of Experiment II: the situation that each assumes, and pictures that hide the gesture.

No baseline uses the picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, cast

from actors.simulator import Image
from actors.tasks.contract import Belief, Blinding, Recollection
from actors.tasks.experiment2.setting import (
    INDICATED_X,
    KINDS,
    ROLES,
    Place,
    variable_name,
)
from actors.tasks.experiment2.world import Y_RANGE_M, YAW_RANGE_DEG
from proto.variables import Situation, Value
from sim_assets.gestures.clip import FRAMES

BLANK_GREY: Final = 128
"""Grey level of the blank screen, in the middle of all levels."""
BLANK_COLUMNS: Final = slice(4, 59)
"""Columns of the picture that the screen fills at the start, and five more on either side."""


def _always(place: Place) -> Belief:
    """Return the belief that the person always points at `place`."""
    return lambda situation: _pointed_at(situation, place)


def _as_before(situation: Situation, before: Situation) -> Situation:
    """Return the situation if the person points where the one of the episode before pointed."""
    return _pointed_at(situation, cast("Place", before[INDICATED_X]))


def _pointed_at(situation: Situation, place: Place) -> Situation:
    """Return the situation with the same objects in which the person points at `place`."""
    if situation[INDICATED_X] == place:
        return situation
    swapped = dict(situation)
    swapped[INDICATED_X] = place
    for value in ("kind", "y_m", "yaw_deg"):
        indicated, other = (f"{role}_{value}" for role in ROLES)
        swapped[indicated], swapped[other] = situation[other], situation[indicated]
    return swapped


def _other_kinds(situation: Situation) -> Situation:
    """Return the situation with objects of the other kind at the same places."""
    kinds = {
        variable_name(role, "kind"): next(
            kind for kind in KINDS if kind != situation[variable_name(role, "kind")]
        )
        for role in ROLES
    }
    return {**situation, **kinds}


def _in_the_middle(situation: Situation) -> Situation:
    """Return the situation with both objects in the middle of the ranges."""
    y_m, yaw_deg = sum(Y_RANGE_M) / 2, sum(YAW_RANGE_DEG) / 2
    middle: dict[str, Value] = {}
    for role in ROLES:
        middle[variable_name(role, "y_m")] = y_m
        middle[variable_name(role, "yaw_deg")] = yaw_deg
    return {**situation, **middle}


def _blank_screen(step: int, image: Image) -> Image:
    """Return the picture with a grey screen while the gesture is shown."""
    if step >= FRAMES:
        return image
    blank = image.copy()
    blank[:, BLANK_COLUMNS] = BLANK_GREY
    return blank


BASELINES: Final[Mapping[str, Belief | Recollection]] = {
    # the gesture is not used: the right object in half of the situations
    "always-negative-x": _always("-0.15"),
    "always-positive-x": _always("0.07"),
    # the gesture of the episode before: the right object in half of the situations
    "last-gesture": Recollection(_as_before),
    # the right object, grasped like one of the other kind
    "kind-blind": _other_kinds,
    # the right object and kind, always at the same Y and yaw
    "pose-blind": _in_the_middle,
}

BLINDED: Final[Mapping[str, Blinding]] = {"blank-screen": _blank_screen}
