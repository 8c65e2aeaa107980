"""Paired comparison: two policies, or one policy in two simulators, in the same situations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from scipy.stats import binomtest

from proto.errors import UserError
from services.trials.success import READINGS, Rate, Tally
from services.trials.trial_log import CountedTrial

_SHOWN: Final = 3
"""Seeds that an error message names."""


@dataclass(frozen=True)
class PairedCounts:
    """How often each of two policies succeeded in the same trials, in one reading.

    Attributes:
        both: both succeeded.
        only_first: the first succeeded and the second failed.
        only_second: the second succeeded and the first failed.
        neither: both failed.
    """

    both: int
    only_first: int
    only_second: int
    neither: int

    @property
    def trials(self) -> int:
        """Number of pairs."""
        return self.both + self.only_first + self.only_second + self.neither

    @property
    def first(self) -> Rate:
        """Success rate of the first."""
        return Rate(self.both + self.only_first, self.trials)

    @property
    def second(self) -> Rate:
        """Success rate of the second."""
        return Rate(self.both + self.only_second, self.trials)

    @property
    def p_value(self) -> float:
        """P value of the exact, two-sided McNemar test.

        Only the pairs in which one of both failed say which is better. If both are equally good,
        such a pair falls to either side with probability 1/2.
        """
        discordant = self.only_first + self.only_second
        return float(binomtest(self.only_first, discordant).pvalue) if discordant else 1.0

    def as_json(self) -> dict[str, Any]:
        """Return counts, rates and p value, for `json.dumps`."""
        return {
            "both": self.both,
            "only_first": self.only_first,
            "only_second": self.only_second,
            "neither": self.neither,
            "first": self.first.as_json(),
            "second": self.second.as_json(),
            "mcnemar_p": self.p_value,
        }


@dataclass(frozen=True)
class PairedTrials:
    """Trials of two policies in the same situations.

    Attributes:
        pairs: both trials of each seed, in order of seeds.
        only_in_first: number of trials that the second lacks.
        only_in_second: number of trials that the first lacks.
    """

    pairs: Sequence[tuple[CountedTrial, CountedTrial]]
    only_in_first: int
    only_in_second: int

    def counts(self, reading: str) -> PairedCounts:
        """Count the pairs in one of READINGS."""
        results = [
            (getattr(first.outcome, reading), getattr(second.outcome, reading))
            for first, second in self.pairs
        ]
        return PairedCounts(
            both=results.count((True, True)),
            only_first=results.count((True, False)),
            only_second=results.count((False, True)),
            neither=results.count((False, False)),
        )

    def as_json(self) -> dict[str, Any]:
        """Return the counts of each reading and the reasons of failure, for `json.dumps`."""
        first, second = (Tally.of(pair[side].outcome for pair in self.pairs) for side in (0, 1))
        return {
            "trials": len(self.pairs),
            "only_in_first": self.only_in_first,
            "only_in_second": self.only_in_second,
            **{reading: self.counts(reading).as_json() for reading in READINGS},
            "reasons": {"first": dict(first.reasons), "second": dict(second.reasons)},
        }


def pair_trials(first: Sequence[CountedTrial], second: Sequence[CountedTrial]) -> PairedTrials:
    """Pair trials that have the same seed.

    Of several policy versions in one list, the newest is taken.

    Raises:
        UserError: no seed is in both, or a seed that is in both is another situation, or was
            played under other disturbances.
    """
    ours, theirs = _by_seed(first), _by_seed(second)
    seeds = sorted(ours.keys() & theirs.keys())
    if not seeds:
        raise UserError(
            "the two have no trial in common; play both with the same --seed, --suite and task"
        )
    differing = [seed for seed in seeds if _conditions(ours[seed]) != _conditions(theirs[seed])]
    if differing:
        named = ", ".join(map(str, differing[:_SHOWN]))
        raise UserError(
            f"{len(differing)} of {len(seeds)} seeds stand for other situations or disturbances"
            f" in the second than in the first (such as {named}); compare trials of the same task"
            " and suite"
        )
    return PairedTrials(
        pairs=[(ours[seed], theirs[seed]) for seed in seeds],
        only_in_first=len(ours) - len(seeds),
        only_in_second=len(theirs) - len(seeds),
    )


def _by_seed(trials: Sequence[CountedTrial]) -> Mapping[int, CountedTrial]:
    newest = max((trial.policy_version for trial in trials), default=0)
    return {trial.seed: trial for trial in trials if trial.policy_version == newest}


def _conditions(trial: CountedTrial) -> object:
    given = trial.conditions
    disturbance = ("", 0.0) if given is None else (given.disturbance, given.strength)
    return dict(trial.situation), disturbance
