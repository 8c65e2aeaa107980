"""Reads outcomes and phases of format 1.

Format 1 stores the measures of an outcome without units beside its readings, and phases without
names. It was written by vmdnn 0.1 before each task defined its measures and phases.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from proto.episode import Measure, Outcome

_UNITS: Final[Mapping[str, str]] = {"m": "m", "mm": "mm", "deg": "deg", "at": "step"}
"""Unit of a measure by the last word of its name."""
_READINGS: Final = ("lenient", "strict", "precise")
_PHASES: Final = 8


def outcome_of(values: Mapping[str, Any]) -> Outcome:
    """Make an outcome from the values of format 1.

    Args:
        values: readings, `reason` and measures by name.

    Raises:
        KeyError, TypeError, ValueError: a value is missing or has the wrong type.
    """
    lenient, strict, precise = (bool(values[reading]) for reading in _READINGS)
    measured = {
        name: Measure(float(value), _UNITS.get(name.rpartition("_")[2], ""))
        for name, value in values.items()
        if name not in (*_READINGS, "reason")
    }
    return Outcome(lenient, strict, precise, str(values["reason"]), measured)


def phase_names() -> tuple[str, ...]:
    """Return names for the eight phases, which have only numbers in format 1."""
    return tuple(f"phase {number}" for number in range(1, _PHASES + 1))
