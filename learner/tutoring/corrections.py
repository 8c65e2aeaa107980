"""Which situations a policy is guided in, and who is at it (dataset aggregation)."""

from __future__ import annotations

import random
import threading
from collections.abc import Sequence
from typing import Protocol

from proto.config import Config
from proto.episode import Episode, Kind
from proto.leases import Leases
from proto.messages import Correction, TutoringRequest, Verdict
from proto.seeds import CORRECTIONS
from proto.variables import Question, Situation

Policy = tuple[str, int]
"""A policy's training and version."""


class Situations(Protocol):
    """What the learner must know of a task.

    Attributes:
        questions: what pre-training asks about its situations.
    """

    questions: tuple[Question, ...]

    def tutored(self) -> Sequence[Situation]:
        """Those that are tutored, always in the same order."""

    def sample(self, seed: int) -> Situation:
        """Any other; the same seed gives the same."""


class Round:
    """Corrections of one policy version, each wanted once. Used by several threads.

    After a restart what is kept still counts, and random and tutored situations are the same ones;
    failures that nobody was guided in yet are forgotten, and looked for again.

    Attributes:
        number: which round it is, from 1.
        most: number of corrections that it has at most.
    """

    def __init__(self, config: Config, number: int, policy: Policy, situations: Situations) -> None:
        """Plan a round.

        Args:
            config: the configuration.
            number: which round it is, from 1.
            policy: the newest policy; no other is guided.
            situations: those of the configuration's task.
        """
        corrections = config.learner.corrections
        self.number = number
        self._task = config.task.name
        self._policy = policy
        self._tries = corrections.tries if corrections.choose == "failures" else 0
        planned = _chosen(config, number, situations)
        self.most = len(planned) or corrections.sequences
        self._missing = {plan.seed: plan for plan in planned}
        self._kept: set[int] = set()
        self._judged: set[int] = set()
        self._leases: Leases[int] = Leases(config.learner.lease_s)
        self._lock = threading.Lock()

    @property
    def kept(self) -> int:
        """Number of its corrections that are there."""
        return len(self._kept)

    @property
    def judged(self) -> int:
        """Number of episodes of practice of its policy whose outcome is known."""
        return len(self._judged)

    @property
    def complete(self) -> bool:
        """Whether all its corrections are there, and no more are looked for."""
        with self._lock:
            return not self._missing and not self._searching

    def judge(self, verdict: Verdict) -> None:
        """Take note of how an episode of practice ended."""
        with self._lock:
            ours = (verdict.run_id, verdict.policy_version) == self._policy
            if not ours or verdict.task != self._task or not self._searching:
                return
            self._judged.add(verdict.seed)
            if not verdict.outcome.precise and verdict.seed not in self._kept:
                plan = Correction(verdict.task, verdict.seed, verdict.situation)
                self._missing[verdict.seed] = plan

    def next_correction(self, request: TutoringRequest) -> Correction | None:
        """A situation for whoever asks; None if nothing is left, or it holds another policy."""
        if (request.run_id, request.policy_version) != self._policy:
            return None
        with self._lock:
            seed = self._leases.take(request.actor, self._missing)
            return None if seed is None else self._missing[seed]

    def release(self, actor: str) -> None:
        """The actor is gone: what it was playing is handed out again."""
        self._leases.release(actor)

    def wants(self, episode: Episode) -> bool:
        """Whether an episode is a correction of this round that is not kept yet."""
        with self._lock:
            return self._lacks(episode)

    def shown(self, episode: Episode) -> None:
        """This episode is kept: nobody need be guided in its situation any more."""
        with self._lock:
            if self._lacks(episode):
                self._missing.pop(episode.seed, None)
                self._kept.add(episode.seed)
                self._leases.finish(episode.seed)

    def _lacks(self, episode: Episode) -> bool:
        return (
            episode.kind is Kind.CORRECTION
            and episode.task == self._task
            and episode.policy_version == self._policy[1]
            and episode.seed not in self._kept
            # one that was asked for before a restart is welcome
            and (episode.seed in self._missing or not self._full)
        )

    @property
    def _full(self) -> bool:
        return len(self._kept) + len(self._missing) >= self.most

    @property
    def _searching(self) -> bool:
        return len(self._judged) < self._tries and not self._full


def _chosen(config: Config, number: int, situations: Situations) -> list[Correction]:
    """The situations of a round that are known when it begins."""
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
