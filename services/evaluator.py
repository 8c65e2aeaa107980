"""The evaluator: hands out trials of the newest policy and counts what succeeds."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import Final

from actors.disturbances.staging import check_suite
from actors.tasks.registry import make_task
from proto.bus import Bus, Inbox
from proto.config import Config
from proto.disturbances import DISTURBANCES, Ability
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
from proto.metrics import EvaluatorMetrics, PolicyScore, Success, SuiteScore
from proto.players import Players
from proto.suites import Player, Suite
from services.trials.success import Tally
from services.trials.trial_log import TrialLog

LOG = logging.getLogger(__name__)

WAITING: Final = 64
"""Messages that may wait to be handled; more are dropped, and sent again by their actors."""
IDLE_S: Final = 0.5
"""How often to look whether it should stop, while no rollout arrives."""

TrialKey = tuple[PolicyKey, str, int]
"""Identifies a trial: the policy, the name of the suite, and the seed."""


class Evaluator:
    """Tries every policy version in the same suites, and counts each trial once.

    It hands out the trials of the first suite first, and to each actor only what it can play.
    """

    def __init__(self, config: Config, bus: Bus, lifecycle: Lifecycle) -> None:
        """Read the trials that were counted before from the run's folder.

        Raises:
            UserError: they cannot be read, or a suite cannot be played with the task.
        """
        if config.evaluator.suites is not None:
            task = make_task(config.task)
            for suite in config.suites:
                check_suite(task, suite)
        self._config = config
        self._bus = bus
        self._lifecycle = lifecycle
        self._log = TrialLog(config.run_folder / "evaluation" / "trials.jsonl")
        self._leases: Leases[TrialKey] = Leases(config.evaluator.lease_s)
        self._suites = {suite.name: suite for suite in config.suites}
        self._players = Players()
        self._unplayable: dict[str, str] = {}
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
                self._look_for_players()

    def metrics(self) -> EvaluatorMetrics:
        """Metrics at this moment."""
        suites = tuple(map(self._suite_score, self._suites.values()))
        return EvaluatorMetrics(
            id=self._bus.id,
            time_s=time.time(),
            refused=self._bus.refused,
            policies=suites[0].policies,
            suites=suites,
            leases=len(self._leases),
            paused=self._lifecycle.paused,
            done=self._done,
        )

    def checkpoint(self) -> str:
        """Write nothing: each trial is on disk as soon as it is counted."""
        return "every counted trial is on disk"

    def _suite_score(self, suite: Suite) -> SuiteScore:
        run_id, _ = self._newest
        return SuiteScore(
            name=suite.name,
            backend=suite.backend,
            trials=len(suite.test_seeds),
            unplayable=self._unplayable.get(suite.name, ""),
            policies=tuple(
                _score(version, self._counted((run_id, version), suite).values())
                for version in self._log.versions(run_id, suite.name)
            ),
        )

    @property
    def _done(self) -> bool:
        """Whether all suites that can be played, and at least one, have the trials."""
        done = self._config.done
        if done.trials is None:
            return done.ever
        _, version = self._newest
        if version < (done.policy_versions or 1):
            return False
        counted = {
            name: len(self._counted(self._newest, suite)) >= min(done.trials, len(suite.test_seeds))
            for name, suite in self._suites.items()
        }
        return any(counted.values()) and all(
            enough or name in self._unplayable for name, enough in counted.items()
        )

    def _on_policy(self, policy: PolicyVersion) -> None:
        run_id, version = self._newest
        if policy.run_id != run_id or policy.version > version:
            self._newest = (policy.run_id, policy.version)
            LOG.info("policy %d is tried from now on", policy.version)

    def _on_presence(self, actor: str, alive: bool) -> None:
        self._players.presence(actor, alive)
        if not alive:
            self._leases.release(actor)

    def _hand_out(self, request: TrialRequest) -> Trial | None:
        self._players.note(request.actor, request.player)
        newest = self._newest
        if self._lifecycle.paused or (request.run_id, request.policy_version) != newest:
            return None
        taken = self._leases.take(request.actor, self._wanted(newest, request.player))
        if taken is None:
            return None
        _, name, seed = taken
        return Trial(seed, self._suites[name].conditions(seed))

    def _wanted(self, policy: PolicyKey, player: Player) -> Iterator[TrialKey]:
        """The trials of a policy that are not counted yet and that a player can play."""
        for suite in self._suites.values():
            for seed in self._missing(policy, suite):
                if player.can_play(suite.backend, suite.conditions(seed)):
                    yield policy, suite.name, seed

    def _missing(self, policy: PolicyKey, suite: Suite) -> list[int]:
        counted = self._counted(policy, suite)
        return [seed for seed in suite.test_seeds if seed not in counted]

    def _look_for_players(self) -> None:
        """Note, and log once, which suites have trials that no present actor can play."""
        unplayable = {}
        for suite in self._suites.values():
            problem = self._unplayable_problem(suite)
            if problem:
                unplayable[suite.name] = problem
                if suite.name not in self._unplayable:
                    LOG.warning("trials of the suite %s are not played: %s", suite.name, problem)
        self._unplayable = unplayable

    def _unplayable_problem(self, suite: Suite) -> str:
        """Why no present actor can play a trial of a suite; empty if all can be played."""
        if not self._missing(self._newest, suite):
            return ""
        if self._players.lack(lambda player: player.backend == suite.backend):
            return f"no actor has {suite.backend}"
        for name in suite.disturbances:
            ability = DISTURBANCES[name].ability
            if self._players.lack(partial(_can_be_disturbed, suite.backend, ability)):
                return f"no actor with {suite.backend} can play the disturbance {name}"
        return ""

    def _receive(self, inbox: Inbox[Rollout]) -> None:
        rollout = inbox.take(timeout_s=IDLE_S)
        if rollout is None:
            return
        episode = rollout.episode
        refusal = self._refusal(episode)
        if not refusal and episode.kind is Kind.TRIAL:
            policy = (rollout.run_id, episode.policy_version)
            self._leases.finish((policy, episode.suite, episode.seed))
            if self._log.add(rollout):
                _report_trial(episode, episode.outcome.reason)
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
                policy = (report.training, report.policy_version)
                self._leases.finish((policy, report.suite, report.seed))
                if self._log.add_failure(report):
                    _report_trial(report, report.problem)
            self._answer(report.actor, Receipt(report.id, refusal))

    def _refusal(self, played: Episode | EpisodeFailed) -> str:
        """Why an episode is no trial and no practice of this run; empty if it is one."""
        if played.task != self._config.task.name:
            return f"this run tests {self._config.task.name}, not {played.task}"
        if played.kind not in (Kind.TRIAL, Kind.PRACTICE):
            return f"an episode of the kind {played.kind} is not evaluated"
        if played.kind is Kind.TRIAL:
            return self._refusal_of_trial(played)
        return self._refusal_of_practice(played)

    def _refusal_of_trial(self, played: Episode | EpisodeFailed) -> str:
        suite = self._suites.get(played.suite)
        if suite is None:
            return f"this run has no suite {played.suite}"
        if played.seed not in suite.test_seeds:
            return f"no trial with the seed {played.seed} is asked for"
        if played.conditions != suite.conditions(played.seed):
            return f"the suite {suite.name} asks for other conditions with the seed {played.seed}"
        if isinstance(played, Episode) and played.backend != suite.backend:
            return f"the suite {suite.name} is played in {suite.backend}, not in {played.backend}"
        return ""

    def _refusal_of_practice(self, played: Episode | EpisodeFailed) -> str:
        for suite in self._suites.values():
            if played.seed in suite.test_seeds:
                return (
                    f"the situation with the seed {played.seed} is one of trials, not of practice"
                )
        return ""

    def _answer(self, actor: str, receipt: Receipt) -> None:
        self._bus.deliver(self._bus.keys.receipt(actor), receipt)

    def _counted(self, policy: PolicyKey, suite: Suite) -> Mapping[int, Outcome]:
        outcomes = self._log.outcomes(*policy, suite.name)
        return {seed: outcome for seed, outcome in outcomes.items() if seed in suite.test_seeds}


def _report_trial(played: Episode | EpisodeFailed, result: str) -> None:
    suite = "" if played.conditions is None else f"{played.suite} "
    LOG.info("policy %d, %strial %d: %s", played.policy_version, suite, played.seed, result)


def _can_be_disturbed(backend: str, ability: Ability | None, player: Player) -> bool:
    return player.backend == backend and (ability is None or ability in player.abilities)


def _verdict(rollout: Rollout) -> Verdict:
    episode = rollout.episode
    return Verdict(
        run_id=rollout.run_id,
        policy_version=episode.policy_version,
        task=episode.task,
        seed=episode.seed,
        situation=episode.situation,
        outcome=episode.outcome,
        backend=episode.backend,
        conditions=episode.conditions,
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
