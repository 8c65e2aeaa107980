"""The evaluator: hands out trials of the newest policy and counts what succeeds."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping
from typing import Final

from learner.tutoring.failures import Failures
from proto.bus import Bus, Inbox
from proto.config import Config
from proto.disk_waits import when_disk_allows
from proto.episode import Episode, Kind, Outcome
from proto.keys import Role
from proto.leases import Leases
from proto.lifecycle import Lifecycle
from proto.membership import alone_in_run, membership
from proto.messages import (
    EpisodeFailed,
    PolicyKey,
    PolicyVersion,
    Receipt,
    Rollout,
    Trial,
    TrialRequest,
    Verdict,
)
from proto.metrics import EvaluatorMetrics, PolicyScore, Success
from services.trials.success import Tally
from services.trials.trial_log import TrialLog

LOG = logging.getLogger(__name__)

WAITING: Final = 64
"""Messages that may wait to be handled; more are dropped, and sent again by their actors."""
IDLE_S: Final = 0.5
"""How often to look whether it should stop, while no rollout arrives."""


class Evaluator:
    """Tries every policy version in the same situations, and counts each trial once."""

    def __init__(self, config: Config, bus: Bus, lifecycle: Lifecycle) -> None:
        """Read the trials that were counted before from the run's folder.

        Raises:
            UserError: they cannot be read.
        """
        self._config = config
        self._bus = bus
        self._lifecycle = lifecycle
        self._log = TrialLog(config.run_folder / "evaluation" / "trials.jsonl")
        self._leases: Leases[tuple[PolicyKey, int]] = Leases(config.evaluator.lease_s)
        first = config.evaluator.seed
        self._seeds = range(first, first + config.evaluator.trials_per_policy)
        self._failures: Failures[tuple[PolicyKey, int]] = Failures()
        self._newest: PolicyKey = ("", 0)

    def run(self) -> None:
        """Evaluate until it should stop.

        Raises:
            UserError: the run has an evaluator already, or a trial cannot be written to disk.
        """
        alone_in_run(self._bus, self._lifecycle)
        keys = self._bus.keys
        rollouts = self._bus.inbox(keys.rollout(), Rollout, capacity=WAITING)
        failures = self._bus.inbox(keys.failure(), EpisodeFailed, capacity=WAITING)
        self._bus.subscribe_newest(keys.policy, self._on_policy, PolicyVersion)
        self._bus.answer(keys.request_trial, TrialRequest, self._hand_out)
        self._bus.watch_presence(Role.ACTOR, self._on_presence)
        with membership(self._bus, self, self._lifecycle):
            while not self._lifecycle.stopping:
                self._receive(rollouts)
                self._receive_failures(failures)

    def metrics(self) -> EvaluatorMetrics:
        """Metrics at this moment."""
        run_id, _ = self._newest
        return EvaluatorMetrics(
            id=self._bus.id,
            time_s=time.time(),
            refused=self._bus.refused,
            policies=tuple(
                _score(version, self._counted((run_id, version)).values())
                for version in self._log.versions(run_id)
            ),
            leases=len(self._leases),
            damaged=self._log.damaged,
            paused=self._lifecycle.paused,
            done=self._done,
        )

    def checkpoint(self) -> str:
        """Write nothing: each trial is on disk as soon as it is counted."""
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
        self._lifecycle.waits_for("" if rollout else self._missing)
        if rollout is None:
            return
        episode = rollout.episode
        refusal = self._refusal(episode)
        if not refusal and episode.kind is Kind.TRIAL:
            self._leases.finish(((rollout.run_id, episode.policy_version), episode.seed))
            if when_disk_allows(self._lifecycle, lambda: self._log.add(rollout)):
                _report_trial(episode.policy_version, episode.seed, episode.outcome.reason)
        elif not refusal:
            self._bus.deliver(self._bus.keys.verdict, _verdict(rollout))
        # A trial that was counted before gets its receipt again.
        self._answer(episode.actor, Receipt(episode.id, refusal))

    def _receive_failures(self, inbox: Inbox[EpisodeFailed]) -> None:
        while (report := inbox.take()) is not None:
            if report.kind is not Kind.TRIAL:  # the learner answers it
                continue
            refusal = self._refusal(report)
            if not refusal:
                trial = (report.training, report.policy_version), report.seed
                self._leases.finish(trial)
                # Otherwise the trial is handed out again.
                if self._failures.add(trial, report.id) and self._count_failure(report):
                    _report_trial(report.policy_version, report.seed, report.problem)
            self._answer(report.actor, Receipt(report.id, refusal))

    def _count_failure(self, report: EpisodeFailed) -> bool:
        return when_disk_allows(self._lifecycle, lambda: self._log.add_failure(report))

    @property
    def _missing(self) -> str:
        """What it waits for while no rollout arrives."""
        if self._bus.hub_is_away:
            return "the hub"
        if not self._newest[1]:
            return "a policy"
        left = len(self._seeds) - len(self._counted(self._newest))
        return f"{left} trials of policy {self._newest[1]}" if left else "the next policy"

    def _refusal(self, played: Episode | EpisodeFailed) -> str:
        """Why an episode is no trial and no practice of this run; empty if it is one."""
        if played.task != self._config.task.name:
            return f"this run tests {self._config.task.name}, not {played.task}"
        if played.kind is Kind.TRIAL and played.seed not in self._seeds:
            return f"no trial with the seed {played.seed} is asked for"
        if played.kind is Kind.PRACTICE and played.seed in self._seeds:
            return f"the situation with the seed {played.seed} is one of trials, not of practice"
        if played.kind not in (Kind.TRIAL, Kind.PRACTICE):
            return f"an episode of the kind {played.kind} is not evaluated"
        return ""

    def _answer(self, actor: str, receipt: Receipt) -> None:
        self._bus.deliver(self._bus.keys.receipt(Role.EVALUATOR, actor), receipt)

    def _counted(self, policy: PolicyKey) -> Mapping[int, Outcome]:
        outcomes = self._log.outcomes(*policy)
        return {seed: outcome for seed, outcome in outcomes.items() if seed in self._seeds}


def _report_trial(policy_version: int, seed: int, result: str) -> None:
    LOG.info("policy %d, trial %d: %s", policy_version, seed, result)


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
