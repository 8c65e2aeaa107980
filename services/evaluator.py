"""The evaluator: hands out trials of the newest policy and counts what succeeds."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping
from typing import Final

from learner.policy_message import policy_of
from learner.tutoring.failures import Failures
from proto.acceptance import PlayedTask, misfit, same_situation
from proto.agreement import OTHER_SETTINGS, Agreement
from proto.bus import Bus
from proto.config import Config
from proto.disk_waits import when_disk_allows
from proto.episode import Episode, Kind, Outcome
from proto.errors import UserError
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
from proto.plain_text import plain
from proto.seeds import PRACTICE
from proto.storage import make_folder
from services.trials.asked import AskedTrials, NotYetError
from services.trials.success import Tally
from services.trials.trial_log import TrialLog

LOG = logging.getLogger(__name__)

WAITING: Final = 64
"""Messages that may wait to be handled; more are dropped, and sent again by their actors."""
IDLE_S: Final = 0.5
"""How often to look whether it should stop, while no rollout arrives."""
VERSIONS_TOLD: Final = 500
"""The metrics have the scores of so many of the newest versions; the log has all."""
REASONS_TOLD: Final = 31
"""The metrics name so many reasons of a version; the others are summed up."""


class Evaluator:
    """Tries every policy version in the same situations, and counts each trial once."""

    def __init__(self, config: Config, bus: Bus, lifecycle: Lifecycle, *, task: PlayedTask) -> None:
        """Read the trials that were counted before from the run's folder.

        Args:
            config: the configuration of the run.
            bus: connection to the other processes.
            lifecycle: says when to pause and to stop.
            task: the task of the run.

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
        self._task = task
        self._agreement = Agreement(config, bus)
        self._folder = config.run_folder / "evaluation"
        self._asked: AskedTrials[int] = AskedTrials(
            self._log.versions, has_predecessor=self._folder.exists()
        )

    def run(self) -> None:
        """Evaluate until it should stop.

        Raises:
            UserError: the run has an evaluator already, its learner has another configuration, or a
                trial cannot be written to disk.
        """
        alone_in_run(self._bus, self._lifecycle)
        self._agreement.check()
        self._agreement.answer()
        make_folder(self._folder)  # shows the next process that there was one before
        keys = self._bus.keys
        rollouts = self._bus.inbox(keys.rollout(), Rollout, capacity=WAITING)
        failures = self._bus.inbox(keys.failure(), EpisodeFailed, capacity=WAITING)
        self._bus.subscribe_newest(keys.policy, self._on_policy, PolicyVersion)
        self._bus.answer(keys.request_trial, TrialRequest, self._hand_out)
        self._bus.watch_presence(Role.ACTOR, self._on_presence)
        with membership(self._bus, self, self._lifecycle):
            while not self._lifecycle.stopping:
                came = rollouts.handle(self._on_rollout, timeout_s=IDLE_S)
                self._lifecycle.waits_for("" if came else self._missing)
                while failures.handle(self._on_failure):
                    pass

    def metrics(self) -> EvaluatorMetrics:
        """Metrics at this moment."""
        run_id, _ = self._asked.newest
        return EvaluatorMetrics(
            id=self._bus.id,
            time_s=time.time(),
            refused=self._bus.refused,
            policies=tuple(
                _score(version, self._counted((run_id, version)).values())
                for version in self._log.versions(run_id)[-VERSIONS_TOLD:]
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
        newest = self._asked.newest
        new_enough = newest[1] >= (done.policy_versions or 1)
        return new_enough and len(self._counted(newest)) >= done.trials

    def _on_policy(self, policy: PolicyVersion) -> None:
        try:
            policy_of(policy, self._config)
        except UserError as error:
            self._bus.refuse(f"policy {policy.version} of {policy.run_id}", error)
            return
        if self._asked.publish((policy.run_id, policy.version)):
            LOG.info("policy %d is tried from now on", policy.version)

    def _on_presence(self, actor: str, alive: bool) -> None:
        if not alive:
            self._leases.release(actor)

    def _hand_out(self, request: TrialRequest) -> Trial | None:
        newest = self._asked.newest
        if request.config_digest != self._agreement.digest:
            self._bus.refuse(f"actor/{request.actor}", OTHER_SETTINGS)
            return None
        if self._lifecycle.paused or (request.run_id, request.policy_version) != newest:
            return None
        counted = self._counted(newest)
        wanted = [(newest, seed) for seed in self._seeds if seed not in counted]
        taken = self._leases.take(request.actor, wanted)
        if taken is None:
            return None
        self._asked.give(newest, taken[1], request.actor)
        return Trial(seed=taken[1])

    def _on_rollout(self, rollout: Rollout) -> None:
        episode = rollout.episode
        try:
            refusal = self._refusal(episode) or self._misfit(rollout)
        except NotYetError:  # without a receipt the actor sends it again
            return
        if not refusal and episode.kind is Kind.TRIAL:
            self._leases.finish(((rollout.run_id, episode.policy_version), episode.seed))
            if when_disk_allows(self._lifecycle, lambda: self._log.add(rollout)):
                _report_trial(episode.policy_version, episode.seed, episode.outcome.reason)
        elif not refusal:
            self._bus.deliver(self._bus.keys.verdict, _verdict(rollout))
        # A trial that was counted before gets its receipt again.
        self._answer(episode.actor, Receipt(episode.id, self._told(episode.actor, refusal)))

    def _on_failure(self, report: EpisodeFailed) -> None:
        if report.kind is not Kind.TRIAL:  # the learner answers it
            return
        try:
            refusal = self._refusal(report)
        except NotYetError:
            return
        if not refusal:
            trial = (report.training, report.policy_version), report.seed
            self._leases.finish(trial)
            # Otherwise the trial is handed out again.
            if self._failures.add(trial, report.id) and self._count_failure(report):
                _report_trial(report.policy_version, report.seed, report.problem)
        self._answer(report.actor, Receipt(report.id, self._told(report.actor, refusal)))

    def _told(self, actor: str, refusal: str) -> str:
        """A refusal as text of a receipt; counted and logged."""
        if refusal:
            self._bus.refuse(f"actor/{actor}", refusal)
        return plain(refusal)[:1000]

    def _count_failure(self, report: EpisodeFailed) -> bool:
        return when_disk_allows(self._lifecycle, lambda: self._log.add_failure(report))

    @property
    def _missing(self) -> str:
        """What it waits for while no rollout arrives."""
        if self._bus.hub_is_away:
            return "the hub"
        _, version = newest = self._asked.newest
        if not version:
            return "a policy"
        left = len(self._seeds) - len(self._counted(newest))
        return f"{left} trials of policy {version}" if left else "the next policy"

    def _refusal(self, played: Episode | EpisodeFailed) -> str:
        """Why an episode is no trial and no practice of this run; empty if it is one.

        Raises:
            NotYetError: its policy is not known yet.
        """
        if played.task != self._config.task.name:
            return f"this run tests {self._config.task.name}, not {played.task}"
        if played.kind not in (Kind.TRIAL, Kind.PRACTICE):
            return f"an episode of the kind {played.kind} is not evaluated"
        if problem := self._seed_problem(played):
            return problem
        policy = (played.training, played.policy_version)
        problem = self._asked.policy_problem(policy)
        if problem or played.kind is Kind.PRACTICE:
            return problem
        if played.seed in self._counted(policy):
            return ""
        return self._asked.trial_problem(policy, played.seed, played.actor)

    def _seed_problem(self, played: Episode | EpisodeFailed) -> str:
        """Why an episode cannot have its seed or situation; empty if it can."""
        if played.kind is Kind.TRIAL and played.seed not in self._seeds:
            return f"no trial with the seed {played.seed} is asked for"
        if played.kind is Kind.PRACTICE and played.seed in self._seeds:
            return f"the situation with the seed {played.seed} is one of trials, not of practice"
        if played.kind is Kind.PRACTICE and played.seed not in PRACTICE:
            return f"the seed {played.seed} is none of practice"
        if not same_situation(played.situation, self._task.sample(played.seed)):
            return f"its situation is not the one of the seed {played.seed}"
        return ""

    def _misfit(self, rollout: Rollout) -> str:
        """Why an episode does not fit the configuration of this run; empty if it does."""
        if rollout.run_id != rollout.episode.training:
            return "it names two trainings"
        if rollout.episode.config_digest != self._agreement.digest:
            return OTHER_SETTINGS
        return misfit(rollout.episode, self._task, self._config.simulator.control_period_s)

    def _answer(self, actor: str, receipt: Receipt) -> None:
        self._bus.deliver(self._bus.keys.receipt(Role.EVALUATOR, actor), receipt)

    def _counted(self, policy: PolicyKey) -> Mapping[int, Outcome]:
        outcomes = self._log.outcomes(*policy)
        return {seed: outcome for seed, outcome in outcomes.items() if seed in self._seeds}


def _report_trial(policy_version: int, seed: int, result: str) -> None:
    LOG.info("policy %d, trial %d: %s", policy_version, seed, plain(result))


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
        reasons=_reasons(tally),
    )


def _reasons(tally: Tally) -> dict[str, int]:
    """The most frequent reasons; all others together as `other`."""
    told = dict(tally.reasons.most_common(REASONS_TOLD))
    if rest := tally.reasons.total() - sum(told.values()):
        told["other"] = told.get("other", 0) + rest
    return told


def _success(tally: Tally, reading: str) -> Success:
    rate = tally.rate(reading)
    return Success(rate.successes, rate.rate, rate.wilson95)
