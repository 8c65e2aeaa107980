"""Baselines of Experiment I: what each takes a situation for. None of them looks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from actors.tasks.contract import Belief
from actors.tasks.experiment1.world import GRID, MIDDLE
from proto.variables import Situation, number_of


def _nearest_tutored(situation: Situation) -> Situation:
    return {
        name: min(values, key=lambda tutored: abs(tutored - number_of(situation, name)))
        for name, values in GRID.items()
        if name in situation
    }


BASELINES: Final[Mapping[str, Belief]] = {
    # one fixed sequence, whatever the situation
    "replay": lambda _: MIDDLE,
    # the right place, always the same orientation
    "yaw-blind": lambda situation: {**situation, "object_yaw_deg": 0.0},
    # the right object, always the same obstacle
    "obstacle-blind": lambda situation: {**situation, "obstacle_x_m": MIDDLE["obstacle_x_m"]},
    # perfect sight, but only the 45 tutored sequences: what a network must pass to generalize
    "lookup": _nearest_tutored,
}
