"""Success rates in the three readings of success, with confidence intervals."""

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
    """Return the 95 % Wilson score interval of a success rate; (0, 1) without trials."""
    if not trials:
        return 0.0, 1.0
    rate = successes / trials
    spread = _Z95**2 / trials
    centre = (rate + spread / 2) / (1 + spread)
    half = math.sqrt(rate * (1 - rate) * spread + spread**2 / 4) / (1 + spread)
    return max(0.0, centre - half), min(1.0, centre + half)


@dataclass(frozen=True)
class Rate:
    """Number of trials, and how many of them succeeded in one reading."""

    successes: int
    trials: int

    @property
    def rate(self) -> float:
        """Fraction of the trials that succeeded; 0 without trials."""
        return self.successes / self.trials if self.trials else 0.0

    @property
    def wilson95(self) -> tuple[float, float]:
        """95 % Wilson score interval of the rate."""
        return wilson95(self.successes, self.trials)

    def as_json(self) -> dict[str, Any]:
        """Return successes, rate and interval, for `json.dumps`."""
        return {"successes": self.successes, "rate": self.rate, "wilson95": list(self.wilson95)}


def pooled(tallies: Iterable[Tally], reading: str) -> Rate:
    """Return the rate over the trials of several tallies."""
    rates = [tally.rate(reading) for tally in tallies]
    return Rate(sum(rate.successes for rate in rates), sum(rate.trials for rate in rates))


def difference95(one: Rate, other: Rate) -> tuple[float, float]:
    """Return Newcombe's 95 % interval of the rate of `one` minus that of `other`.

    It is computed from the Wilson intervals of both rates.
    """
    difference = one.rate - other.rate
    (one_low, one_high), (other_low, other_high) = one.wilson95, other.wilson95
    return (
        difference - math.hypot(one.rate - one_low, other_high - other.rate),
        difference + math.hypot(one_high - one.rate, other.rate - other_low),
    )


@dataclass
class Tally:
    """Counted outcomes.

    Attributes:
        trials: number of counted outcomes.
        successes: number of successes by reading.
        reasons: number of outcomes that were not precise, by reason.
    """

    trials: int = 0
    successes: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)

    @classmethod
    def of(cls, outcomes: Iterable[Outcome]) -> Tally:
        """Count outcomes."""
        tally = cls()
        for outcome in outcomes:
            tally.add(outcome)
        return tally

    def add(self, outcome: Outcome) -> None:
        """Count one more outcome."""
        self.trials += 1
        self.successes.update(reading for reading in READINGS if getattr(outcome, reading))
        if outcome.reason != NO_FAILURE:
            self.reasons[outcome.reason] += 1

    def rate(self, reading: str) -> Rate:
        """Return the success rate in one of READINGS."""
        return Rate(self.successes[reading], self.trials)

    def as_json(self) -> dict[str, Any]:
        """Return `trials`, the rate of each reading, and `reasons`, for `json.dumps`."""
        rates = {reading: self.rate(reading).as_json() for reading in READINGS}
        return {"trials": self.trials, **rates, "reasons": dict(self.reasons)}
