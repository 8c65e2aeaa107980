"""Baselines of Experiment II: what each takes a situation for. None of them looks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from actors.tasks.contract import Belief
from actors.tasks.experiment2.setting import (
    INDICATED_X,
    KINDS,
    ROLES,
    Place,
    variable_name,
)
from actors.tasks.experiment2.world import Y_RANGE_M, YAW_RANGE_DEG
from proto.variables import Situation, Value


def _always(place: Place) -> Belief:
    """The belief that the person always points at one place."""

    def belief(situation: Situation) -> Situation:
        return (
            situation if situation[INDICATED_X] == place else _pointed_elsewhere(situation, place)
        )

    return belief


def _pointed_elsewhere(situation: Situation, place: Place) -> Situation:
    """The same objects, of which the person points at the one at `place`."""
    swapped = dict(situation)
    swapped[INDICATED_X] = place
    for value in ("kind", "y_m", "yaw_deg"):
        indicated, other = (f"{role}_{value}" for role in ROLES)
        swapped[indicated], swapped[other] = situation[other], situation[indicated]
    return swapped


def _other_kinds(situation: Situation) -> Situation:
    """The same places, at which every object is of the other kind."""
    kinds = {
        variable_name(role, "kind"): next(
            kind for kind in KINDS if kind != situation[variable_name(role, "kind")]
        )
        for role in ROLES
    }
    return {**situation, **kinds}


def _in_the_middle(situation: Situation) -> Situation:
    """The same kinds, in the middle of the ranges."""
    y_m, yaw_deg = sum(Y_RANGE_M) / 2, sum(YAW_RANGE_DEG) / 2
    middle: dict[str, Value] = {}
    for role in ROLES:
        middle[variable_name(role, "y_m")] = y_m
        middle[variable_name(role, "yaw_deg")] = yaw_deg
    return {**situation, **middle}


BASELINES: Final[Mapping[str, Belief]] = {
    # the gesture is not looked at: right in half of the situations
    "always-negative-x": _always("-0.15"),
    "always-positive-x": _always("0.07"),
    # the right object, grasped as the other kind is
    "kind-blind": _other_kinds,
    # the right object and kind, always at the same Y and yaw
    "pose-blind": _in_the_middle,
}
