"""Labels and grasp errors of Experiment I for figures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from actors.tasks.contract import FigureWords, GraspError
from actors.tasks.experiment1 import judge
from proto.episode import NO_FAILURE, Outcome
from proto.variables import Situation, number_of


def _measured(name: str) -> Callable[[Outcome, Situation], float]:
    return lambda outcome, _: outcome.value(name)


def _offset_in_y_mm(outcome: Outcome, situation: Situation) -> float:
    """Offset of the hand from the object along Y of the task frame."""
    turn = np.deg2rad(number_of(situation, "object_yaw_deg"))
    along, across = outcome.value("along_mm"), outcome.value("across_mm")
    return float(along * np.cos(turn) - across * np.sin(turn))


def _in_place(outcome: Outcome) -> bool:
    return (
        outcome.value("closed_at") >= 0
        and outcome.value("moved_mm") <= judge.MOVED_MM
        and outcome.value("turned_deg") <= judge.TURNED_DEG
    )


FIGURE_WORDS: Final = FigureWords(
    reasons={
        NO_FAILURE: "precise",
        judge.IMPRECISE: "strict, not precise",
        judge.NOT_LIFTED: "not lifted",
        judge.NEVER_CLOSED: "never closed",
        judge.MOVED_OBJECT: "moved the object",
        judge.TOUCHED_OBSTACLE: "touched the obstacle",
    },
    errors=(
        GraspError(
            "yaw_error_deg",
            "yaw error\n(degrees)",
            judge.YAW_ERROR_DEG,
            _measured("yaw_error_deg"),
            variable="object_yaw_deg",
        ),
        GraspError("along_mm", "offset along\n(mm)", judge.ALONG_MM, _measured("along_mm")),
        GraspError("across_mm", "offset across\n(mm)", judge.ACROSS_MM, _measured("across_mm")),
        GraspError(
            "position_mm",
            "offset in Y\n(mm)",
            judge.ALONG_MM,
            _offset_in_y_mm,
            variable="object_y_m",
            per_unit=1e3,
        ),
    ),
    in_place=_in_place,
)
