"""Counting what succeeded, in the three readings of success, with honest intervals."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final

from proto.episode import NO_FAILURE, Outcome

READINGS: Final = ("lenient", "strict", "precise")
"""From the least to the most demanding; see `proto.episode.Outcome`."""

_Z95: Final = 1.959963984540054  # 97.5 % quantile of the normal distribution


def wilson95(successes: int, trials: int) -> tuple[float, float]:
    """Wilson score interval at 95 % for a success rate; (0, 1) where nothing was tried."""
    if not trials:
        return 0.0, 1.0
    rate = successes / trials
    spread = _Z95**2 / trials
    centre = (rate + spread / 2) / (1 + spread)
    half = math.sqrt(rate * (1 - rate) * spread + spread**2 / 4) / (1 + spread)
    return max(0.0, centre - half), min(1.0, centre + half)


@dataclass(frozen=True)
class Rate:
    """How many of the trials succeeded in one reading."""

    successes: int
    trials: int

    @property
    def rate(self) -> float:
        """Share of the trials that succeeded, 0 where nothing was tried."""
        return self.successes / self.trials if self.trials else 0.0

    @property
    def wilson95(self) -> tuple[float, float]:
        """Interval that holds the true rate with 95 % confidence."""
        return wilson95(self.successes, self.trials)

    def as_json(self) -> dict[str, Any]:
        """For `json.dumps`."""
        return {"successes": self.successes, "rate": self.rate, "wilson95": list(self.wilson95)}


def pooled(tallies: Iterable[Tally], reading: str) -> Rate:
    """The rate over the trials of several tallies."""
    rates = [tally.rate(reading) for tally in tallies]
    return Rate(sum(rate.successes for rate in rates), sum(rate.trials for rate in rates))


def difference95(one: Rate, other: Rate) -> tuple[float, float]:
    """Newcombe's interval at 95 % for how much higher the rate of `one` is, from Wilson's."""
    difference = one.rate - other.rate
    (one_low, one_high), (other_low, other_high) = one.wilson95, other.wilson95
    return (
        difference - math.hypot(one.rate - one_low, other_high - other.rate),
        difference + math.hypot(one_high - one.rate, other.rate - other_low),
    )


@dataclass
class Tally:
    """Outcomes counted by reading, and by why they fell short of `precise`.

    Attributes:
        trials: how many were counted.
        successes: how many succeeded, by reading.
        reasons: how many fell short, by reason; a reason that never applied is not there.
    """

    trials: int = 0
    successes: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)

    @classmethod
    def of(cls, outcomes: Iterable[Outcome]) -> Tally:
        """Count some outcomes."""
        tally = cls()
        for outcome in outcomes:
            tally.add(outcome)
        return tally

    def add(self, outcome: Outcome) -> None:
        """Count one more."""
        self.trials += 1
        self.successes.update(reading for reading in READINGS if getattr(outcome, reading))
        if outcome.reason != NO_FAILURE:
            self.reasons[outcome.reason] += 1

    def rate(self, reading: str) -> Rate:
        """The rate in one of READINGS."""
        return Rate(self.successes[reading], self.trials)

    def as_json(self) -> dict[str, Any]:
        """`trials`, each reading's rate, and `reasons`, for `json.dumps`."""
        rates = {reading: self.rate(reading).as_json() for reading in READINGS}
        return {"trials": self.trials, **rates, "reasons": dict(self.reasons)}
