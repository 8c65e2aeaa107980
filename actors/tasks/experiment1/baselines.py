"""Baselines of Experiment I: the situation that each assumes. They do not use the picture."""

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
    # one fixed sequence in every situation
    "replay": lambda _: MIDDLE,
    # the right place, always the same orientation
    "yaw-blind": lambda situation: {**situation, "object_yaw_deg": 0.0},
    # the right object, always the same obstacle
    "obstacle-blind": lambda situation: {**situation, "obstacle_x_m": MIDDLE["obstacle_x_m"]},
    # the tutored sequence nearest to the real situation: a network that generalizes must be better
    "lookup": _nearest_tutored,
}
