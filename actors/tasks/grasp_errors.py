"""Errors of a grasp that figures show, for tasks whose judge measures the pose of the hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from actors.tasks.contract import GraspError
from actors.tasks.grasp_reading import GraspTolerance
from proto.episode import Outcome
from proto.variables import Situation, number_of


def grasp_errors(tolerance: GraspTolerance, *, yaw: str, y: str) -> tuple[GraspError, ...]:
    """Return the errors of a grasp in yaw, along and across the object, and in Y.

    The outcomes must have the attributes of `HandOffset` as measures.

    Args:
        tolerance: largest errors of a precise grasp.
        yaw: name of the variable for the object's yaw (degrees).
        y: name of the variable for the object's Y (m).
    """

    def offset_in_y_mm(outcome: Outcome, situation: Situation) -> float:
        """Offset of the hand from the object along Y of the task frame."""
        turn = np.deg2rad(number_of(situation, yaw))
        along, across = outcome.value("along_mm"), outcome.value("across_mm")
        return float(along * np.cos(turn) - across * np.sin(turn))

    return (
        GraspError(
            "yaw_error_deg",
            "yaw error\n(degrees)",
            tolerance.yaw_error_deg,
            _measured("yaw_error_deg"),
            variable=yaw,
        ),
        GraspError("along_mm", "offset along\n(mm)", tolerance.along_mm, _measured("along_mm")),
        GraspError("across_mm", "offset across\n(mm)", tolerance.across_mm, _measured("across_mm")),
        GraspError(
            "position_mm",
            "offset in Y\n(mm)",
            tolerance.along_mm,
            offset_in_y_mm,
            variable=y,
            per_unit=1e3,
        ),
    )


def _measured(name: str) -> Callable[[Outcome, Situation], float]:
    return lambda outcome, _: outcome.value(name)
