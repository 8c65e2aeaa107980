"""In which situations a policy is guided, and which actor plays which (dataset aggregation)."""

from __future__ import annotations

import random
import threading
from collections.abc import Iterable
from typing import Protocol

from learner.tutoring.failures import Failures, Shown
from proto.acceptance import PlayedTask, same_situation
from proto.config import Config
from proto.episode import Kind
from proto.leases import Leases
from proto.messages import Correction, EpisodeFailed, PolicyKey, TutoringRequest, Verdict
from proto.seeds import CORRECTIONS, TRIALS_BELOW
from proto.situations import situation_of
from proto.suites import Player, Suite, suite_of
from proto.variables import Question, Situation


class Situations(PlayedTask, Protocol):
    """What the learner must know of a task.

    Attributes:
        questions: what pre-training asks about its situations.
        distractors: variables that the tutor's actions do not depend on.
    """

    questions: tuple[Question, ...]
    distractors: frozenset[str]


class Round:
    """Corrections of one policy version, each wanted once. Used by several threads.

    After a restart the kept corrections still count, and random and tutored situations are the
    same as before. Failed situations that were not corrected yet are forgotten: practice has to
    find such situations again.

    Attributes:
        number: number of the round, from 1.
        most: number of corrections that the round has at most.
    """

    def __init__(
        self,
        config: Config,
        number: int,
        policy: PolicyKey,
        situations: Situations,
        *,
        resumed: bool = False,
    ) -> None:
        """Plan a round.

        Args:
            config: the configuration.
            number: number of the round, from 1.
            policy: the newest policy, which is guided.
            situations: situations of the configuration's task.
            resumed: whether a former process began the round. It may have asked for corrections of
                failures that this process does not know of; they are accepted as well.
        """
        corrections = config.learner.corrections
        self.number = number
        self._suites = {suite.name: suite for suite in config.practised_suites()}
        self._tested = tuple(suite.test_seeds for suite in config.suites)
        self._backends = config.tutoring_backends
        self._task = config.task.name
        self._policy = policy
        self._situations = situations
        self._asked_before = resumed and corrections.choose == "failures"
        self._tries = corrections.tries if corrections.choose == "failures" else 0
        planned = _chosen(config, number, situations)
        self.most = len(planned) or corrections.sequences
        self._missing = {plan.seed: plan for plan in planned}
        self._kept: set[int] = set()
        self._judged: set[int] = set()
        self._given_up: set[int] = set()
        self._failures: Failures[int] = Failures()
        self._leases: Leases[int] = Leases(config.learner.lease_s)
        self._lock = threading.Lock()

    @property
    def kept(self) -> int:
        """Number of corrections that are kept."""
        return len(self._kept)

    @property
    def judged(self) -> int:
        """Number of episodes of practice of the policy whose outcome is known."""
        return len(self._judged)

    @property
    def complete(self) -> bool:
        """Whether all corrections are kept, and no further failures are waited for."""
        with self._lock:
            return not self._missing and not self._searching

    def judge(self, verdict: Verdict) -> str:
        """Note how an episode of practice ended; a failure becomes a correction to ask for.

        Returns:
            Why the verdict is ignored because it cannot be true; empty otherwise.
        """
        with self._lock:
            ours = (verdict.run_id, verdict.policy_version) == self._policy
            if not ours or verdict.task != self._task or not self._searching:
                return ""
            if problem := self._practice_problem(verdict):
                return problem
            self._judged.add(verdict.seed)
            done = self._kept | self._given_up
            if not verdict.outcome.precise and verdict.seed not in done:
                self._missing[verdict.seed] = Correction(
                    verdict.task, verdict.seed, verdict.situation, verdict.conditions
                )
            return ""

    def next_correction(self, request: TutoringRequest) -> Correction | None:
        """A situation for an actor; None if none is left, or if the actor has another policy."""
        if (request.run_id, request.policy_version) != self._policy:
            return None
        with self._lock:
            playable = (
                seed for seed, plan in self._missing.items() if self._fits(plan, request.player)
            )
            seed = self._leases.take(request.actor, playable)
            if seed is None:
                return None
            self._failures.ask(seed, request.actor)
            return self._missing[seed]

    def is_played_by(self, player: Player) -> bool:
        """Whether a player can play what the round waits for, if it waits for anything."""
        with self._lock:
            if not self._missing and not self._searching:
                return True
            if any(self._fits(plan, player) for plan in self._missing.values()):
                return True
            return self._searching and any(
                suite.backend == player.backend for suite in self._suites.values()
            )

    def release(self, actor: str) -> None:
        """Hand out again what an actor that vanished was playing."""
        self._leases.release(actor)

    def wants(self, shown: Shown) -> bool:
        """Whether a sequence is a correction of this round that is not kept yet."""
        with self._lock:
            return self._lacks(shown)

    def keep(self, shown: Shown) -> None:
        """Note that a sequence is kept: its situation need not be corrected any more."""
        with self._lock:
            if self._lacks(shown):
                self._missing.pop(shown.seed, None)
                self._kept.add(shown.seed)
                self._leases.finish(shown.seed)

    def fail(self, report: EpisodeFailed) -> bool:
        """Note that a correction could not be shown; whether it is given up for that.

        Otherwise it is handed out again. The report of an actor that was not asked is ignored.
        """
        with self._lock:
            if not self._is_of_policy(report) or report.seed not in self._missing:
                return False
            if not self._failures.fail(report.seed, report, self._leases):
                return False
            del self._missing[report.seed]
            self._given_up.add(report.seed)
            return True

    def _practice_problem(self, verdict: Verdict) -> str:
        """Why an episode was no practice of a suite that is practised; empty if it was."""
        suite = self._suites.get(suite_of(verdict.conditions))
        if suite is None or self._is_tested(verdict.seed) or not _may_be_practised(suite, verdict):
            return f"its seed {verdict.seed} is none of practice, or its conditions are others"
        wanted = situation_of(self._situations, verdict.conditions, verdict.seed)
        if not same_situation(verdict.situation, wanted):
            return f"its situation is not the one of the seed {verdict.seed}"
        return ""

    def _is_tested(self, seed: int) -> bool:
        """Whether a seed is one of a suite's trials; nothing is learned from their situations."""
        return any(seed in tested for tested in self._tested)

    def _is_practised(self, seed: int) -> bool:
        return any(seed in suite.practice_seeds for suite in self._suites.values())

    def _fits(self, plan: Correction, player: Player) -> bool:
        """Whether a player can play a correction, in the world in which the policy failed."""
        if self._tries:
            backend = self._suites[suite_of(plan.conditions)].backend
            return player.can_play(backend, plan.conditions)
        return player.backend in self._backends

    def _lacks(self, shown: Shown) -> bool:
        return (
            self._is_of_policy(shown)
            and not (self._tries and self._is_tested(shown.seed))
            and shown.seed not in self._kept
            and (
                shown.seed in self._missing
                or (self._asked_before and self._is_practised(shown.seed) and not self._full)
            )
        )

    def _is_of_policy(self, shown: Shown) -> bool:
        return (
            shown.kind is Kind.CORRECTION
            and shown.task == self._task
            and (shown.training, shown.policy_version) == self._policy
        )

    @property
    def _full(self) -> bool:
        return len(self._kept) + len(self._missing) >= self.most

    @property
    def _searching(self) -> bool:
        return len(self._judged) < self._tries and not self._full


def situation_of_correction(
    shown: Shown, suites: Iterable[Suite], situations: Situations
) -> Situation | None:
    """Return the situation that a correction must have; None if it cannot have been asked for.

    Args:
        shown: the correction.
        suites: the suites that are practised.
        situations: situations of the task.
    """
    seed, conditions = shown.seed, shown.conditions
    for suite in suites:
        if seed in suite.practice_seeds:
            asked = conditions == suite.conditions(seed)
            return situation_of(situations, conditions, seed) if asked else None
    if conditions is not None:
        return None
    if seed in CORRECTIONS:
        return situations.sample(seed)
    tutored = situations.tutored() if seed < TRIALS_BELOW else ()
    return tutored[seed] if seed < len(tutored) else None


def _may_be_practised(suite: Suite, verdict: Verdict) -> bool:
    """Whether simulator, seed and conditions of an episode are those of a suite's practice."""
    return (
        verdict.backend == suite.backend
        and verdict.seed in suite.practice_seeds
        and verdict.conditions == suite.conditions(verdict.seed)
    )


def _chosen(config: Config, number: int, situations: Situations) -> list[Correction]:
    """The corrections of a round that are known when it begins."""
    corrections, task = config.learner.corrections, config.task.name
    match corrections.choose:
        case "failures":
            return []
        case "random":
            chance = random.Random(f"corrections {config.run.seed} {number}")
            seeds = chance.sample(CORRECTIONS, corrections.sequences)
            return [Correction(task, seed, situations.sample(seed)) for seed in seeds]
        case "tutored":
            tutored = situations.tutored()
            cases = list(dict.fromkeys(config.learner.cases or range(len(tutored))))
            count = min(corrections.sequences, len(cases))
            start = (number - 1) * count
            turns = [cases[(start + turn) % len(cases)] for turn in range(count)]
            return [Correction(task, case, tutored[case]) for case in turns]
