"""The evaluator: hands out trials of the newest policy and counts what succeeds."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping
from typing import Final

from proto.bus import Bus, Inbox
from proto.config import Config
from proto.episode import Episode, Kind, Outcome
from proto.keys import Role
from proto.leases import Leases
from proto.lifecycle import Lifecycle
from proto.membership import alone_in_run, membership
from proto.messages import PolicyVersion, Receipt, Rollout, Trial, TrialRequest, Verdict
from proto.metrics import EvaluatorMetrics, PolicyScore, Success
from services.trials.success import Tally
from services.trials.trial_log import TrialLog

LOG = logging.getLogger(__name__)

WAITING: Final = 64
"""Rollouts that may wait to be counted; more are dropped, and sent again by their actors."""
IDLE_S: Final = 0.5

PolicyKey = tuple[str, int]
"""A policy's training and version."""


class Evaluator:
    """Gives every policy version the same situations, and counts each trial once."""

    def __init__(self, config: Config, bus: Bus, lifecycle: Lifecycle) -> None:
        """Find what was counted before in the run's folder."""
        self._config = config
        self._bus = bus
        self._lifecycle = lifecycle
        self._book = TrialLog(config.run_folder / "evaluation" / "trials.jsonl")
        self._leases: Leases[tuple[PolicyKey, int]] = Leases(config.evaluator.lease_s)
        first = config.evaluator.seed
        self._seeds = range(first, first + config.evaluator.trials_per_policy)
        self._newest: PolicyKey = ("", 0)

    def run(self) -> None:
        """Evaluate until it should stop.

        Raises:
            UserError: the run has an evaluator already.
        """
        alone_in_run(self._bus, self._lifecycle)
        keys = self._bus.keys
        inbox = self._bus.inbox(keys.rollout(), Rollout, capacity=WAITING)
        self._bus.subscribe_newest(keys.policy, self._on_policy, PolicyVersion)
        self._bus.answer(keys.request_trial, TrialRequest, self._hand_out)
        self._bus.watch_presence(Role.ACTOR, self._on_presence)
        with membership(self._bus, self, self._lifecycle):
            while not self._lifecycle.stopping:
                self._receive(inbox)

    def metrics(self) -> EvaluatorMetrics:
        """What it tells about itself."""
        run_id, _ = self._newest
        return EvaluatorMetrics(
            id=self._bus.id,
            time_s=time.time(),
            refused=self._bus.refused,
            policies=tuple(
                _score(version, self._counted((run_id, version)).values())
                for version in self._book.versions(run_id)
            ),
            leases=len(self._leases),
            paused=self._lifecycle.paused,
            done=self._done,
        )

    def checkpoint(self) -> str:
        """Nothing is to be saved: each trial is on disk as soon as it is counted."""
        return "every counted trial is on disk"

    @property
    def _done(self) -> bool:
        done = self._config.done
        if done.trials is None:
            return done.ever
        _, version = self._newest
        new_enough = version >= (done.policy_versions or 1)
        return new_enough and len(self._counted(self._newest)) >= done.trials

    def _on_policy(self, policy: PolicyVersion) -> None:
        run_id, version = self._newest
        if policy.run_id != run_id or policy.version > version:
            self._newest = (policy.run_id, policy.version)
            LOG.info("policy %d is tried from now on", policy.version)

    def _on_presence(self, actor: str, alive: bool) -> None:
        if not alive:
            self._leases.release(actor)

    def _hand_out(self, request: TrialRequest) -> Trial | None:
        newest = self._newest
        if self._lifecycle.paused or (request.run_id, request.policy_version) != newest:
            return None
        counted = self._counted(newest)
        wanted = [(newest, seed) for seed in self._seeds if seed not in counted]
        taken = self._leases.take(request.actor, wanted)
        return None if taken is None else Trial(seed=taken[1])

    def _receive(self, inbox: Inbox[Rollout]) -> None:
        rollout = inbox.take(timeout_s=IDLE_S)
        if rollout is None:
            return
        episode = rollout.episode
        if self._is_trial(episode):
            self._leases.finish(((rollout.run_id, episode.policy_version), episode.seed))
            if self._book.add(rollout):
                LOG.info(
                    "policy %d, trial %d: %s",
                    episode.policy_version,
                    episode.seed,
                    episode.outcome.reason,
                )
        elif self._is_practice(episode):
            self._bus.deliver(self._bus.keys.verdict, _verdict(rollout))
        # Practice and what was counted already need not be sent again either.
        self._bus.deliver(self._bus.keys.receipt(episode.actor), Receipt(episode.id))

    def _is_trial(self, episode: Episode) -> bool:
        """Whether it is one of the trials that this configuration asks for."""
        return self._is(Kind.TRIAL, episode) and episode.seed in self._seeds

    def _is_practice(self, episode: Episode) -> bool:
        """Whether the learner may hear of it: never of the situations of trials."""
        return self._is(Kind.PRACTICE, episode) and episode.seed not in self._seeds

    def _is(self, kind: Kind, episode: Episode) -> bool:
        return episode.kind is kind and episode.task == self._config.task.name

    def _counted(self, policy: PolicyKey) -> Mapping[int, Outcome]:
        outcomes = self._book.outcomes(*policy)
        return {seed: outcome for seed, outcome in outcomes.items() if seed in self._seeds}


def _verdict(rollout: Rollout) -> Verdict:
    episode = rollout.episode
    return Verdict(
        run_id=rollout.run_id,
        policy_version=episode.policy_version,
        task=episode.task,
        seed=episode.seed,
        situation=episode.situation,
        outcome=episode.outcome,
    )


def _score(version: int, outcomes: Iterable[Outcome]) -> PolicyScore:
    tally = Tally.of(outcomes)
    return PolicyScore(
        version=version,
        trials=tally.trials,
        lenient=_success(tally, "lenient"),
        strict=_success(tally, "strict"),
        precise=_success(tally, "precise"),
        reasons=dict(tally.reasons),
    )


def _success(tally: Tally, reading: str) -> Success:
    rate = tally.rate(reading)
    return Success(rate.successes, rate.rate, rate.wilson95)
