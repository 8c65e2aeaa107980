"""How long a run has taken, and an estimate of what is left of it."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from proto.metrics import ActorMetrics, LearnerMetrics, Metrics, Stage, SuiteScore
from services.board import RunView


@dataclass(frozen=True)
class Progress:
    """How far a run is in time.

    Attributes:
        elapsed_s: time since the run was started or continued (s); None if no process is there.
        left_s: time that is left (s); None if it cannot be estimated yet, or the work is done.
        at_least: whether more time is needed, for work whose speed is not known yet.
    """

    elapsed_s: float | None = None
    left_s: float | None = None
    at_least: bool = False


class _Work(StrEnum):
    """The kinds of work of a run, in their order."""

    SEQUENCES = "sequences"
    PRETRAINING = "epochs of pre-training"
    COUPLED = "epochs of coupled training"
    CORRECTIONS = "rounds of corrections"
    TRIALS = "episodes played with a policy"


class ProgressMeter:
    """Estimates what is left of a run from the speed of each kind of work so far.

    The run waits for one kind of work at a time: for sequences, for an epoch, for the corrections
    of a round, and at the end for trials. The time between two views is time of this kind. Actors
    play at any time, so the speed of trials is that of all episodes since the first policy.
    """

    def __init__(
        self, *, started_s: float | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin without any measurement.

        Args:
            started_s: when the run was started or continued, in the time of `clock`; without it,
                when the process that has been there for the longest time joined it.
            clock: gives the time in seconds.
        """
        self._started_s = started_s
        self._clock = clock
        self._last: tuple[float, Mapping[_Work, int], Collection[_Work]] | None = None
        self._time_s: dict[_Work, float] = defaultdict(float)
        self._done: dict[_Work, int] = defaultdict(int)

    def look(self, view: RunView) -> Progress:
        """Take in a view; return how far the run is."""
        now_s = self._clock()
        elapsed_s = self._elapsed(view, now_s)
        learner = next(iter(view.living(LearnerMetrics)), None)
        if learner is None:
            self._last = None
            return Progress(elapsed_s)
        done = _done(view, learner)
        if self._last is not None:
            before_s, before, works = self._last
            for work in works:
                self._time_s[work] += now_s - before_s
                self._done[work] += max(0, done[work] - before[work])
        self._last = now_s, done, list(_present_work(view, learner))
        left_s, at_least = self._left(_left(view, learner))
        return Progress(elapsed_s, left_s, at_least)

    def _elapsed(self, view: RunView, now_s: float) -> float | None:
        if self._started_s is not None:
            return now_s - self._started_s
        return max((each.running_s for each in view.living(Metrics)), default=None)

    def _left(self, left: Mapping[_Work, int]) -> tuple[float | None, bool]:
        """Estimate the time of some work (s), and whether a part of it is not in the estimate."""
        missing = {work for work, count in left.items() if count}
        known = {work for work in missing if self._done[work]}
        if not known:
            return None, bool(missing)
        left_s = sum(left[work] * self._time_s[work] / self._done[work] for work in known)
        return left_s, known != missing


def _present_work(view: RunView, learner: LearnerMetrics) -> Iterator[_Work]:
    """Yield the work that the run waits for, and that of its actors."""
    if learner.policy_version:
        yield _Work.TRIALS
    if learner.stage is Stage.PRETRAINING:
        yield _Work.PRETRAINING
    elif learner.stage is Stage.COUPLED:
        yield _Work.COUPLED
    elif _waits_for_corrections(learner):
        yield _Work.CORRECTIONS
    elif learner.stage is Stage.WAITING and view.living(ActorMetrics):
        yield _Work.SEQUENCES


def _done(view: RunView, learner: LearnerMetrics) -> dict[_Work, int]:
    pretraining = learner.epochs_later > 0
    return {
        _Work.SEQUENCES: learner.sequences,
        _Work.PRETRAINING: learner.epoch if pretraining else 0,
        _Work.COUPLED: 0 if pretraining else learner.epoch,
        _Work.CORRECTIONS: learner.round - _waits_for_corrections(learner),
        _Work.TRIALS: sum(actor.episodes for actor in view.living(ActorMetrics)),
    }


def _left(view: RunView, learner: LearnerMetrics) -> dict[_Work, int]:
    pretraining = learner.epochs_later > 0
    in_stage = max(0, learner.epochs_total - learner.epoch)
    trials = sum(suite.trials for suite in view.suites)
    if learner.stage is Stage.FINISHED:
        trials = max(0, trials - counted_trials(view.suites, learner.policy_version))
    return {
        _Work.SEQUENCES: learner.sequences_total - learner.sequences,
        _Work.PRETRAINING: in_stage if pretraining else 0,
        _Work.COUPLED: learner.epochs_later if pretraining else in_stage,
        _Work.CORRECTIONS: learner.rounds - learner.round + _waits_for_corrections(learner),
        _Work.TRIALS: trials,
    }


def _waits_for_corrections(learner: LearnerMetrics) -> bool:
    return learner.stage is Stage.WAITING and learner.corrections_total > 0


def counted_trials(suites: Sequence[SuiteScore], version: int) -> int:
    """Return the number of counted trials of a policy version in all suites."""
    return sum(
        score.trials for suite in suites for score in suite.policies if score.version == version
    )
