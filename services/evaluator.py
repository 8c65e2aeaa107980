"""The evaluator: hands out trials of the newest policy and counts what succeeds."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache, partial
from typing import Final

from actors.disturbances.staging import check_suite
from actors.tasks.contract import Task
from learner.policy_message import policy_limit, policy_of
from learner.tutoring.failures import Failures
from proto.acceptance import outcome_misfit, same_situation
from proto.agreement import OTHER_SETTINGS, Agreement
from proto.bus import Bus, Inbox
from proto.config import Config
from proto.disk_waits import when_disk_allows
from proto.disturbances import DISTURBANCES, Ability
from proto.episode import Kind, Outcome
from proto.errors import UserError
from proto.keys import Role
from proto.leases import Leases
from proto.lifecycle import Lifecycle
from proto.membership import alone_in_run, membership
from proto.messages import (
    EpisodeFailed,
    EpisodeOutcome,
    PolicyKey,
    PolicyVersion,
    Receipt,
    Trial,
    TrialRequest,
    Verdict,
)
from proto.metrics import EvaluatorMetrics, LearnerMetrics, PolicyScore, Stage, Success, SuiteScore
from proto.plain_text import plain
from proto.players import Players
from proto.situations import situation_of
from proto.storage import make_folder
from proto.suites import Conditions, Player, Suite
from proto.variables import Situation
from services.terminal.run_words import outcome_words
from services.trials.asked import AskedTrials, NotYetError
from services.trials.run_folder import trial_log_file
from services.trials.success import Tally
from services.trials.trial_log import TrialLog

LOG = logging.getLogger(__name__)

OUTCOMES_WAITING: Final = 4096
"""Outcomes that may wait to be handled; more are dropped, and sent again by their actors."""
WAITING: Final = 64
"""The same for reports of failed simulations."""
AT_ONCE: Final = 256
"""Trials that are written to disk together."""
TOLD_SINGLY: Final = 16
"""Of more trials that are counted together the log tells the success rate only."""
IDLE_S: Final = 0.5
"""How often to look whether it should stop, while no outcome arrives."""
VERSIONS_TOLD: Final = 500
"""The metrics have the scores of so many of the newest versions; the log has all."""
VERSIONS_NAMED: Final = 20
"""The log names so many versions in one line."""
REASONS_TOLD: Final = 31
"""The metrics name so many reasons of a version; the others are summed up."""
SEEDS_REMEMBERED: Final = 10_000
"""Of so many seeds it remembers what they stand for. Each policy is tried with the same ones."""

TrialGroup = tuple[PolicyKey, str]
"""Identifies the trials of a policy in a suite."""
TrialKey = tuple[PolicyKey, str, int]
"""Identifies a trial: the policy, the name of the suite, and the seed."""


class Evaluator:
    """Tries every policy version in the same suites, and counts each trial once.

    It hands out the trials of the first suite first, and to each actor only what it can play.
    When all trials of the newest version are handed out, and the learner needs no practice, it
    catches up on versions that were followed too soon by a newer one.
    """

    def __init__(self, config: Config, bus: Bus, lifecycle: Lifecycle, *, task: Task) -> None:
        """Read the trials that were counted before from the run's folder.

        Args:
            config: the configuration of the run.
            bus: connection to the other processes.
            lifecycle: says when to pause and to stop.
            task: the task of the run.

        Raises:
            UserError: they cannot be read, or a suite cannot be played with the task.
        """
        for suite in config.suites:
            check_suite(task, suite)
        self._config = config
        self._bus = bus
        self._lifecycle = lifecycle
        self._log = TrialLog(trial_log_file(config.run_folder))
        self._leases: Leases[TrialKey] = Leases(config.evaluator.lease_s)
        self._suites = {suite.name: suite for suite in config.suites}
        self._practised = {suite.name: suite for suite in config.practised_suites()}
        self._players = Players()
        self._unplayable: dict[str, str] = {}
        self._stage: Stage | None = None  # of the learner
        self._held: dict[str, tuple[int, ...]] = {}  # older versions that each actor can act with
        self._not_held: set[PolicyKey] = set()  # of which the log says that no actor has them
        self._failures: Failures[TrialKey] = Failures()
        self._taken: list[EpisodeOutcome] = []  # to be counted and answered
        self._task = task
        self._meaning = lru_cache(SEEDS_REMEMBERED)(self._drawn)
        self._scores: dict[TrialGroup, PolicyScore] = {}
        self._agreement = Agreement(config, bus)
        self._folder = config.run_folder / "evaluation"
        self._asked: AskedTrials[tuple[str, int]] = AskedTrials(
            self._log.tried_versions, has_predecessor=self._folder.exists()
        )

    def run(self) -> None:
        """Evaluate until it should stop.

        Raises:
            UserError: the run has an evaluator already, its learner has another configuration, or a
                trial cannot be written to disk.
        """
        with alone_in_run(self._bus, self._lifecycle):
            self._run()

    def _run(self) -> None:
        self._agreement.check()
        self._agreement.answer()
        make_folder(self._folder)  # shows the next process that there was one before
        keys = self._bus.keys
        outcomes = self._bus.inbox(keys.outcome(), EpisodeOutcome, capacity=OUTCOMES_WAITING)
        failures = self._bus.inbox(keys.failure(), EpisodeFailed, capacity=WAITING)
        self._bus.subscribe_newest(
            keys.policy,
            self._on_policy,
            PolicyVersion,
            limit=policy_limit(self._config.network),
        )
        self._bus.answer(keys.request_trial, TrialRequest, self._hand_out)
        self._bus.subscribe(keys.metrics(Role.LEARNER), self._on_learner, LearnerMetrics)
        self._bus.watch_presence(Role.ACTOR, self._on_presence)
        with membership(self._bus, self, self._lifecycle):
            look_at_s = 0.0
            while not self._lifecycle.stopping:
                came = self._receive(outcomes)
                self._lifecycle.waits_for("" if came else self._waited_for)
                while failures.handle(self._on_failure):
                    pass
                if not came or time.monotonic() >= look_at_s:
                    self._look_for_players()
                    self._look_for_holders()
                    look_at_s = time.monotonic() + IDLE_S

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
            damaged=self._log.damaged,
            paused=self._lifecycle.paused,
            done=self._done,
        )

    def checkpoint(self) -> str:
        """Write nothing: each trial is on disk as soon as it is counted."""
        return "every counted trial is on disk"

    def _suite_score(self, suite: Suite) -> SuiteScore:
        run_id, _ = self._asked.newest
        return SuiteScore(
            name=suite.name,
            backend=suite.backend,
            trials=len(suite.test_seeds),
            unplayable=self._unplayable.get(suite.name, ""),
            policies=tuple(
                self._score((run_id, version), suite)
                for version in self._log.versions(run_id, suite.name)[-VERSIONS_TOLD:]
            ),
        )

    def _score(self, policy: PolicyKey, suite: Suite) -> PolicyScore:
        """The score of a policy, computed again only when more of its trials have been counted."""
        counted, known = self._counted(policy, suite), self._scores.get((policy, suite.name))
        if known is None or known.trials != len(counted):
            known = self._scores[policy, suite.name] = _score(policy[1], counted.values())
        return known

    @property
    def _done(self) -> bool:
        """Whether all suites that can be played, and at least one, have the trials."""
        done = self._config.done
        if done.trials is None:
            return done.ever
        newest = self._asked.newest
        if newest[1] < (done.policy_versions or 1):
            return False
        counted = {
            name: len(self._counted(newest, suite)) >= min(done.trials, len(suite.test_seeds))
            for name, suite in self._suites.items()
        }
        return any(counted.values()) and all(
            enough or name in self._unplayable for name, enough in counted.items()
        )

    def _on_policy(self, policy: PolicyVersion) -> None:
        try:
            policy_of(policy, self._config)
        except UserError as error:
            self._bus.refuse(f"policy {policy.version} of {policy.run_id}", error)
            return
        if self._asked.publish((policy.run_id, policy.version)):
            LOG.info("policy %d is tried from now on", policy.version)

    def _on_learner(self, metrics: LearnerMetrics) -> None:
        self._stage = metrics.stage

    def _on_presence(self, actor: str, alive: bool) -> None:
        self._players.presence(actor, alive)
        if not alive:
            self._leases.release(actor)
            self._held.pop(actor, None)

    def _hand_out(self, request: TrialRequest) -> Trial | None:
        newest = self._asked.newest
        if request.config_digest != self._agreement.digest:
            self._bus.refuse(f"actor/{request.actor}", OTHER_SETTINGS)
            return None
        self._players.note(request.actor, request.player)
        policy = (request.run_id, request.policy_version)
        if self._lifecycle.paused or policy[0] != newest[0] or not 1 <= policy[1] <= newest[1]:
            return None
        if policy == newest:
            self._held[request.actor] = request.older
        else:  # it holds newer ones too, which it does not name
            self._held.pop(request.actor, None)
        taken = self._leases.take(request.actor, self._wanted(request, policy))
        if taken is None:
            return None
        (_, version), name, seed = taken
        self._asked.give(taken[0], (name, seed), request.actor)
        LOG.debug("policy %d: trial %d of %s goes to %s", version, seed, name, request.actor)
        return Trial(version, seed, self._suites[name].conditions(seed))

    def _wanted(self, request: TrialRequest, policy: PolicyKey) -> Iterator[TrialKey]:
        """The trials that an actor may play, the most important first."""
        newest = self._asked.newest
        first = None if policy == newest else self._config.evaluator.first_trials
        yield from self._missing_of(policy, request.player, first)
        if policy == newest and not self._practice_is_needed:
            for version in sorted(request.older, reverse=True):
                if 1 <= version < newest[1]:
                    yield from self._missing_of((policy[0], version), request.player)

    def _missing_of(
        self, policy: PolicyKey, player: Player, first: int | None = None
    ) -> Iterator[TrialKey]:
        """The trials of a policy that are not counted yet and that a player can play.

        Args:
            policy: the policy.
            player: the player.
            first: only so many trials of each suite; None for all.
        """
        for suite in self._suites.values():
            for seed in self._missing(policy, suite, first):
                if player.can_play(suite.backend, suite.conditions(seed)):
                    yield policy, suite.name, seed

    def _missing(self, policy: PolicyKey, suite: Suite, first: int | None = None) -> list[int]:
        """The first trials of a suite, or all, that are not counted yet."""
        counted = self._log.seeds(*policy, suite.name)
        return [seed for seed in suite.test_seeds[:first] if seed not in counted]

    @property
    def _practice_is_needed(self) -> bool:
        """Whether the learner waits for what comes of practice: failures to be corrected."""
        return self._stage is Stage.WAITING

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
        if not self._missing(self._asked.newest, suite):
            return ""
        if self._players.lack(lambda player: player.backend == suite.backend):
            return f"no actor has {suite.backend}"
        for name in suite.disturbances:
            ability = DISTURBANCES[name].ability
            if self._players.lack(partial(_can_be_disturbed, suite.backend, ability)):
                return f"no actor with {suite.backend} can play the disturbance {name}"
        return ""

    def _look_for_holders(self) -> None:
        """Log, once, which earlier versions lack trials that no present actor can play."""
        run_id, newest = self._asked.newest
        held = dict(self._held)
        if self._practice_is_needed or not self._players.all_among(held):
            return
        if any(self._lacking(run_id, newest)):
            return
        told = range(max(1, newest - VERSIONS_TOLD), newest)
        versions = set(told).difference(*held.values())
        lacking = [
            version
            for version in sorted(versions)
            if (run_id, version) not in self._not_held and any(self._lacking(run_id, version))
        ]
        if not lacking:
            return
        self._not_held.update((run_id, version) for version in lacking)
        LOG.warning(
            "no actor has %s any more, so the rest of their trials is not played;"
            " `vmdnn evaluate --run %s --policy-version all` plays it",
            *(_versions_words(lacking), self._config.run_folder),
        )

    def _lacking(self, run_id: str, version: int) -> Iterator[int]:
        """How many trials of each suite a version lacks."""
        for suite in self._suites.values():
            yield len(self._missing((run_id, version), suite))

    def _receive(self, inbox: Inbox[EpisodeOutcome]) -> bool:
        """Handle the outcomes that have arrived; False if none arrives for some time.

        All trials among them are written to disk at once, which takes as long as for one.
        """
        came = inbox.handle(self._on_outcome, timeout_s=IDLE_S)
        while len(self._taken) < AT_ONCE and inbox.handle(self._on_outcome):
            pass
        taken, self._taken = self._taken, []
        trials = [played for played in taken if played.kind is Kind.TRIAL]
        _report(when_disk_allows(self._lifecycle, lambda: self._log.add_outcomes(trials)))
        for played in trials:
            policy = (played.training, played.policy_version)
            self._leases.finish((policy, played.suite, played.seed))
        for played in taken:  # a trial that was counted before gets its receipt again
            key = self._bus.keys.receipt(Role.EVALUATOR, played.actor)
            self._bus.deliver(key, Receipt(played.id), check=False)  # its id was checked
        return came

    def _on_outcome(self, played: EpisodeOutcome) -> None:
        try:
            refusal = self._refusal(played) or self._misfit(played)
        except NotYetError:  # without a receipt the actor sends it again
            return
        if refusal:
            receipt = Receipt(played.id, self._told(played.actor, refusal))
            self._answer(played.actor, receipt)
            return
        if played.kind is Kind.PRACTICE:
            # Its fields were checked as those of the outcome.
            self._bus.deliver(self._bus.keys.verdict, _verdict(played), check=False)
        self._taken.append(played)

    def _on_failure(self, report: EpisodeFailed) -> None:
        if report.kind is not Kind.TRIAL:  # the learner answers it
            return
        try:
            refusal = self._refusal(report)
        except NotYetError:
            return
        if not refusal:
            policy = (report.training, report.policy_version)
            trial = (policy, report.suite, report.seed)
            if not self._failures.counts(trial, report.id):  # the trial may be played again now
                self._leases.finish(trial, report.actor)
            # Otherwise the trial is handed out again.
            if self._failures.add(trial, report.id) and self._count_failure(report):
                _report_trial(report, report.problem)
        self._answer(report.actor, Receipt(report.id, self._told(report.actor, refusal)))

    def _told(self, actor: str, refusal: str) -> str:
        """A refusal as text of a receipt; counted and logged."""
        if refusal:
            self._bus.refuse(f"actor/{actor}", refusal)
        return plain(refusal)[:1000]

    def _count_failure(self, report: EpisodeFailed) -> bool:
        return when_disk_allows(self._lifecycle, lambda: self._log.add_failure(report))

    @property
    def _waited_for(self) -> str:
        """What it waits for while no outcome arrives."""
        if self._bus.hub_is_away:
            return "the hub"
        _, version = newest = self._asked.newest
        if not version:
            return "a policy"
        if left := sum(self._lacking(*newest)):
            return f"{left} trials of policy {version}"
        if len(self._leases):
            return "trials of earlier policies"
        return "the next policy"

    def _refusal(self, played: EpisodeOutcome | EpisodeFailed) -> str:
        """Why an episode is no trial and no practice of this run; empty if it is one.

        Raises:
            NotYetError: its policy is not known yet.
        """
        if played.task != self._config.task.name:
            return f"this run tests {self._config.task.name}, not {played.task}"
        if played.kind not in (Kind.TRIAL, Kind.PRACTICE):
            return f"an episode of the kind {played.kind} is not evaluated"
        suite = (self._suites if played.kind is Kind.TRIAL else self._practised).get(played.suite)
        if suite is None:
            return f"this run has no suite {played.suite} for an episode of the kind {played.kind}"
        return (
            self._seed_problem(played, suite)
            or self._conditions_problem(played, suite)
            or self._asked_problem(played, suite)
        )

    def _seed_problem(self, played: EpisodeOutcome | EpisodeFailed, suite: Suite) -> str:
        """Why an episode cannot have its seed; empty if it can."""
        seed = played.seed
        if played.kind is Kind.TRIAL:
            known = seed in suite.test_seeds
            return "" if known else f"no trial with the seed {seed} is asked for"
        if any(seed in each.test_seeds for each in self._suites.values()):
            return f"the situation with the seed {seed} is one of trials, not of practice"
        return "" if seed in suite.practice_seeds else f"the seed {seed} is none of practice"

    def _conditions_problem(self, played: EpisodeOutcome | EpisodeFailed, suite: Suite) -> str:
        """Why an episode is not what its seed stands for in a suite; empty if it is."""
        conditions, situation = self._meaning(suite.name, played.seed, played.kind)
        if played.conditions != conditions:
            return f"the suite {suite.name} asks for other conditions with the seed {played.seed}"
        if isinstance(played, EpisodeOutcome) and played.backend != suite.backend:
            return f"the suite {suite.name} is played in {suite.backend}, not in {played.backend}"
        if not same_situation(played.situation, situation):
            return f"its situation is not the one of the seed {played.seed}"
        return ""

    def _drawn(self, name: str, seed: int, kind: Kind) -> tuple[Conditions | None, Situation]:
        """What a seed stands for in a suite."""
        suites = self._suites if kind is Kind.TRIAL else self._practised
        conditions = suites[name].conditions(seed)
        return conditions, situation_of(self._task, conditions, seed)

    def _asked_problem(self, played: EpisodeOutcome | EpisodeFailed, suite: Suite) -> str:
        """Why an episode was not asked for; empty if it was, or was counted before."""
        policy = (played.training, played.policy_version)
        problem = self._asked.policy_problem(policy)
        if problem or played.kind is Kind.PRACTICE:
            return problem
        if played.seed in self._log.seeds(*policy, suite.name):
            return ""
        return self._asked.trial_problem(policy, (suite.name, played.seed), played.actor)

    def _misfit(self, played: EpisodeOutcome) -> str:
        """Why an episode does not fit the configuration of this run; empty if it does."""
        if played.config_digest != self._agreement.digest:
            return OTHER_SETTINGS
        return outcome_misfit(played, self._task, self._config.simulator.control_period_s)

    def _answer(self, actor: str, receipt: Receipt) -> None:
        self._bus.deliver(self._bus.keys.receipt(Role.EVALUATOR, actor), receipt)

    def _counted(self, policy: PolicyKey, suite: Suite) -> Mapping[int, Outcome]:
        outcomes = self._log.outcomes(*policy, suite.name)
        return {seed: outcome for seed, outcome in outcomes.items() if seed in suite.test_seeds}


def _versions_words(versions: list[int]) -> str:
    """Such as `policy 3`, or `policies 1, 2 and 5 more`."""
    named, more = versions[:VERSIONS_NAMED], len(versions) - VERSIONS_NAMED
    words = ", ".join(map(str, named)) + (f" and {more} more" if more > 0 else "")
    return f"policy {words}" if len(versions) == 1 else f"the policies {words}"


def _report(trials: list[EpisodeOutcome]) -> None:
    """Log what has been counted: each trial, or how many of each policy if there are many."""
    if len(trials) <= TOLD_SINGLY:
        for played in trials:
            _report_trial(played, outcome_words(played.outcome.reason))
        return
    groups: dict[tuple[int, str], list[Outcome]] = {}
    for played in trials:
        groups.setdefault((played.policy_version, _suite_words(played)), []).append(played.outcome)
    for (version, suite), outcomes in groups.items():
        strict = sum(outcome.strict for outcome in outcomes)
        LOG.info("policy %d, %d %strials: %d strict", version, len(outcomes), suite, strict)


def _report_trial(played: EpisodeOutcome | EpisodeFailed, result: str) -> None:
    suite, version = _suite_words(played), played.policy_version
    LOG.info("policy %d, %strial %d: %s", version, suite, played.seed, plain(result))


def _suite_words(played: EpisodeOutcome | EpisodeFailed) -> str:
    """The suite of a trial, unless it is the usual one, before a noun."""
    return "" if played.conditions is None else f"{played.suite} "


def _can_be_disturbed(backend: str, ability: Ability | None, player: Player) -> bool:
    return player.backend == backend and (ability is None or ability in player.abilities)


def _verdict(played: EpisodeOutcome) -> Verdict:
    return Verdict(
        run_id=played.training,
        policy_version=played.policy_version,
        task=played.task,
        seed=played.seed,
        situation=played.situation,
        outcome=played.outcome,
        backend=played.backend,
        conditions=played.conditions,
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
