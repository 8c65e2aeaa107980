"""What files of format 1 hold differently: outcomes without a table of measures, unnamed phases.

Format 1 was written by vmdnn 0.1 before tasks named their own measures and phases.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from proto.episode import Measure, Outcome

_UNITS: Final[Mapping[str, str]] = {"m": "m", "mm": "mm", "deg": "deg", "at": "step"}
"""Units by the last word of a measure's name."""
_READINGS: Final = ("lenient", "strict", "precise")
_PHASES: Final = 8


def outcome_of(values: Mapping[str, Any]) -> Outcome:
    """The outcome that a flat table of readings, reason and measures says.

    Raises:
        KeyError, TypeError, ValueError: it is no such table.
    """
    lenient, strict, precise = (bool(values[reading]) for reading in _READINGS)
    measured = {
        name: Measure(float(value), _UNITS.get(name.rpartition("_")[2], ""))
        for name, value in values.items()
        if name not in (*_READINGS, "reason")
    }
    return Outcome(lenient, strict, precise, str(values["reason"]), measured)


def phase_names() -> tuple[str, ...]:
    """Names for the eight phases, which had numbers only."""
    return tuple(f"phase {number}" for number in range(1, _PHASES + 1))
