"""Outcomes of Experiment I for tests that need no simulator."""

from __future__ import annotations

from proto.episode import NO_FAILURE, Measure, Outcome


def measures(**changed: float) -> dict[str, Measure]:
    """Return the measures of a good grasp in Experiment I, with some values changed."""
    values = {
        "lifted_m": (0.1, "m"),
        "moved_mm": (1.0, "mm"),
        "turned_deg": (2.0, "deg"),
        "yaw_error_deg": (3.0, "deg"),
        "along_mm": (4.0, "mm"),
        "across_mm": (5.0, "mm"),
        "closed_at": (80.0, "step"),
        "obstacle_touched_at": (-1.0, "step"),
    }
    return {
        name: Measure(float(changed.get(name, value)), unit)
        for name, (value, unit) in values.items()
    }


PRECISE = Outcome(True, True, True, NO_FAILURE, measures())
IMPRECISE = Outcome(True, True, False, "imprecise", measures(yaw_error_deg=11))
TOUCHED = Outcome(True, False, False, "touched_obstacle", measures(obstacle_touched_at=30))
NOT_LIFTED = Outcome(False, False, False, "not_lifted", measures(lifted_m=0))
