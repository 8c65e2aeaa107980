"""The actor as a process plays the requested episodes and loses nothing; without rendering."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from subprocess import Popen
from typing import Any

import numpy as np
import pytest
from deadly_simulator import DEADLY_CASE, DEADLY_SEED
from fitting import make_policy
from outcomes import NOT_LIFTED, PRECISE
from ports import free_endpoint
from processes import PATIENCE_S, eventually, listening_hub, stop, vmdnn

from actors.left_outboxes import LeftOutboxes
from actors.receipts import Receipts
from actors.tasks.experiment1.plan import plan
from actors.tasks.registry import make_task
from proto.bus import Bus, open_bus
from proto.codec import encode
from proto.config import (
    HubConfig,
    RecorderConfig,
    TaskConfig,
    load_config,
)
from proto.disturbances import Ability
from proto.episode import Episode, Kind
from proto.keys import Keys, Role
from proto.messages import (
    Command,
    Control,
    ControlReply,
    Correction,
    EpisodeFailed,
    EpisodeOutcome,
    Live,
    PolicyVersion,
    Receipt,
    Rollout,
    Sequence,
    Trial,
    TrialRequest,
    TutoringCase,
    TutoringRequest,
)
from proto.metrics import ActorMetrics
from proto.outbox import IN_FLIGHT, Outbox
from proto.run_locks import own_id
from proto.seeds import PRACTICE
from proto.suites import Conditions, Player

MakeEpisode = Callable[..., Episode]
TASK = make_task(TaskConfig())
SAPIEN = Player("sapien", tuple(sorted(Ability)))


@pytest.fixture(scope="module")
def policy() -> Callable[..., PolicyVersion]:
    """Return a function that makes versions of a policy with random weights."""
    return make_policy


class ActorSetup:
    """A hub, an actor, and sessions that play the roles of learner, evaluator and recorder."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._stack = stack
        self.outbox = folder / "test" / "outbox" / "actor-1"
        self.log = folder / "actor.log"
        self.endpoint = free_endpoint()
        self.words = (
            *("--connect", self.endpoint, "--set", f"run.folder={folder}"),
            *("--set", "run.name=test", "--set", "simulator.render=false"),
        )
        self.cases: list[TutoringCase | Correction] = []
        self.requests: list[TutoringRequest] = []
        self.trials: list[Trial] = []
        self.first_trials: dict[int, list[Trial]] = {}
        self.trial_requests: list[TrialRequest] = []
        self.sequences: list[Episode] = []
        self.rollouts: list[Rollout] = []
        self.outcomes: list[EpisodeOutcome] = []
        self.lives: list[Live] = []
        self.metrics: ActorMetrics | None = None
        self.failures: list[EpisodeFailed] = []
        self.gives_receipts = True
        self.recorders = [Role.RECORDER]
        self.refusal = ""
        self.hub: Popen[bytes]
        self.actor: Popen[bytes]
        self.start_hub()
        self.bus: Bus = stack.enter_context(
            open_bus(HubConfig(endpoint=self.endpoint), "test", Role.LEARNER, "learner")
        )
        self.receivers: dict[Role, Bus] = {Role.LEARNER: self.bus}
        for role in (Role.EVALUATOR, Role.RECORDER):
            self.receivers[role] = stack.enter_context(
                open_bus(HubConfig(endpoint=self.endpoint), "test", role, str(role))
            )
        for bus in self.receivers.values():
            bus.announce()
        self._lock = threading.Lock()
        keys = self.bus.keys
        self.bus.answer(keys.request_tutoring, TutoringRequest, self._on_request)
        self.bus.answer(keys.request_trial, TrialRequest, self._on_trial_request)
        self.bus.subscribe(keys.sequence(), self._on_sequence, Sequence)
        self.bus.subscribe(keys.rollout(), self._on_rollout, Rollout)
        self.bus.subscribe(keys.outcome(), self._on_outcome, EpisodeOutcome)
        self.bus.subscribe(keys.failure(), self._on_failure, EpisodeFailed)
        self.bus.subscribe(keys.live(), self.lives.append, Live)
        self.bus.subscribe(keys.metrics(Role.ACTOR), self._on_metrics, ActorMetrics)

    def start_hub(self) -> None:
        self.hub = self._stack.enter_context(listening_hub(self.endpoint))

    def start_actor(self, *more: str) -> None:
        self.metrics = None
        words = (*self.words, "--id", "actor-1", *more)
        self.actor = self._stack.enter_context(vmdnn("actor", *words, log=self.log))

    def publish(self, policy: PolicyVersion) -> None:
        self.bus.publish_newest(self.bus.keys.policy, policy)

    def holds(self, run_id: str, version: int) -> bool:
        """Whether the actor has asked for a case with this policy."""
        return any((r.run_id, r.policy_version) == (run_id, version) for r in self.requests)

    def wait_for_metrics(self, ready: Callable[[ActorMetrics], bool]) -> ActorMetrics:
        """Wait until the newest metrics satisfy `ready`."""
        eventually(lambda: self.metrics is not None and ready(self.metrics), "the expected metrics")
        assert self.metrics is not None
        return self.metrics

    def command(self, command: Command) -> list[str]:
        control = self.bus.keys.control(Role.ACTOR)
        return [r.note for r in self.bus.ask(control, Control(command), ControlReply)]

    def _on_request(self, request: TutoringRequest) -> object | None:
        self.requests.append(request)
        return self._next(self.cases)

    def _on_trial_request(self, request: TrialRequest) -> object | None:
        self.trial_requests.append(request)
        return self._next(self.first_trials.get(request.policy_version, self.trials))

    def _next(self, things: list[Any]) -> object | None:
        with self._lock:
            return things.pop(0) if things else None

    def _on_sequence(self, sequence: Sequence) -> None:
        self.sequences.append(sequence.episode)
        self._acknowledge(sequence.episode, Role.LEARNER)

    def _on_rollout(self, rollout: Rollout) -> None:
        self.rollouts.append(rollout)
        self._acknowledge(rollout.episode, *self.recorders)

    def _on_outcome(self, outcome: EpisodeOutcome) -> None:
        self.outcomes.append(outcome)
        self._acknowledge(outcome, Role.EVALUATOR)

    def _on_metrics(self, metrics: ActorMetrics) -> None:
        self.metrics = metrics

    def _on_failure(self, report: EpisodeFailed) -> None:
        self.failures.append(report)
        role = Role.EVALUATOR if report.kind is Kind.TRIAL else Role.LEARNER
        self._give(role, report.actor, Receipt(report.id))

    def _acknowledge(self, episode: Episode | EpisodeOutcome, *roles: Role) -> None:
        for role in roles if self.gives_receipts else ():
            receipt = Receipt(episode.id, self.refusal)
            self._give(role, episode.actor, receipt)

    def _give(self, role: Role, actor: str, receipt: Receipt) -> None:
        self.receivers[role].deliver(self.bus.keys.receipt(role, actor), receipt)


@pytest.fixture
def setup(tmp_path: Path) -> Iterator[ActorSetup]:
    with ExitStack() as stack:
        yield ActorSetup(stack, tmp_path)


def test_it_demonstrates_cases_plays_trials_and_practises(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    setup.cases += [
        TutoringCase("experiment1", 3, 0),
        TutoringCase("experiment1", 99, 0),
        TutoringCase("experiment9", 3, 0),
        TutoringCase("experiment1", 3, 1),
        TutoringCase("reaching", 14, 0),
    ]
    setup.start_actor("--set", "learner.pretraining.task=reaching")
    eventually(lambda: len(setup.sequences) == 3, "three demonstrations")
    clean, noisy, reaching = setup.sequences
    assert (reaching.task, reaching.seed) == ("reaching", 14000)
    assert dict(reaching.situation) == {"object_y_m": 0.30, "object_yaw_deg": 45.0}
    assert "obstacle" not in reaching.body_names
    assert (clean.seed, noisy.seed) == (3000, 3001)
    assert dict(clean.situation) == dict(noisy.situation) == dict(TASK.tutored()[3])
    assert {clean.kind, noisy.kind} == {Kind.TUTORING}
    assert np.array_equal(clean.actions, clean.targets)
    assert not np.array_equal(noisy.actions, noisy.targets)
    assert np.array_equal(noisy.targets, clean.targets)
    metrics = setup.wait_for_metrics(lambda metrics: metrics.episodes == 3 and metrics.outbox == 0)
    assert metrics.policy_version == 0
    assert metrics.last_kind is Kind.TUTORING
    assert metrics.last_outcome == reaching.outcome.reason

    setup.trials.append(Trial(1, 1234))
    setup.publish(policy(1))
    eventually(lambda: len(setup.rollouts) >= 2, "a trial, then practice")
    trial, practice = setup.rollouts[:2]
    assert (trial.run_id, trial.episode.policy_version) == ("training", 1)
    assert (trial.episode.kind, trial.episode.seed) == (Kind.TRIAL, 1234)
    assert dict(trial.episode.situation) == dict(TASK.sample(1234))
    assert trial.episode.outputs is not None
    assert practice.episode.kind is Kind.PRACTICE
    assert practice.episode.seed in PRACTICE

    assert setup.command(Command.PAUSE) == ["paused"]
    paused = setup.wait_for_metrics(lambda metrics: metrics.paused and metrics.steps_per_s == 0)
    setup.cases.append(TutoringCase("experiment1", 0, 0))
    assert (
        setup.wait_for_metrics(lambda t: t.time_s > paused.time_s + 1).episodes == paused.episodes
    )
    assert setup.command(Command.RESUME) == ["resumed"]
    eventually(lambda: len(setup.sequences) == 4, "it plays again")
    assert stop(setup.actor) == 0


def test_its_policy_is_guided_in_situations_that_the_learner_requests(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    situation = dict(TASK.sample(3))
    asked = Correction("experiment1", 3, situation)
    setup.cases.append(asked)  # the actor has no policy yet
    setup.start_actor("--set", "tutor.guidance_deg=2")
    eventually(lambda: "no policy to be guided" in setup.log.read_text(), "a warning")
    assert {(r.run_id, r.policy_version) for r in setup.requests} == {("", 0)}

    setup.publish(policy(4))
    eventually(lambda: setup.holds("training", 4), "it holds it")
    outside = {**situation, "object_y_m": 0.9}
    setup.cases += [Correction("experiment1", 4, outside), asked]
    eventually(lambda: len(setup.sequences) == 1, "a correction")
    assert "object_y_m = 0.9 lies outside" in setup.log.read_text()
    (episode,) = setup.sequences
    assert (episode.kind, episode.policy, episode.policy_version) == (Kind.CORRECTION, "guided", 4)
    assert (episode.seed, dict(episode.situation)) == (3, situation)
    assert episode.training == "training"
    np.testing.assert_allclose(episode.targets, plan(situation), atol=1e-4)
    off = np.abs(episode.actions - episode.targets)
    assert off.max() <= 2.0 + 1e-4
    assert off.max() > 1.0, "the actions are those of the policy"
    setup.wait_for_metrics(lambda metrics: metrics.outbox == 0)


def test_a_policy_changes_between_episodes_only(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    def acts_with(version: int) -> bool:
        return any(live.policy_version == version for live in list(setup.lives))

    setup.publish(policy(1))
    setup.start_actor()
    eventually(lambda: acts_with(1), "it acts with policy 1")
    setup.publish(replace(policy(2), weights=b"damaged"))
    eventually(lambda: "policy 2 cannot be used" in setup.log.read_text(), "a warning")
    setup.publish(policy(3))
    eventually(lambda: acts_with(3), "it acts with policy 3")
    setup.publish(policy(2))  # older than 3, so it is ignored
    seen_rollouts = len(setup.rollouts)
    eventually(lambda: len(setup.rollouts) >= seen_rollouts + 2, "more episodes")
    setup.publish(policy(1, run_id="new"))  # but a new training begins at 1
    eventually(lambda: any(r.run_id == "new" for r in setup.rollouts), "the new training")
    setup.actor.kill()

    seen = [(live.policy_version, live.step) for live in list(setup.lives)]
    changes = [after for before, after in pairwise(seen) if before[0] != after[0]]
    assert [version for version, _ in changes] == [3, 1]
    assert {step for _, step in changes} == {0}
    versions = [(r.run_id, r.episode.policy_version) for r in list(setup.rollouts)]
    assert list(dict.fromkeys(versions)) == [("training", 1), ("training", 3), ("new", 1)]


def test_policies_that_do_not_fit_are_refused_and_it_goes_on(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    setup.publish(policy(1))
    setup.start_actor()
    eventually(lambda: bool(setup.rollouts), "it practises with policy 1")
    other = load_config(None, ["network.mstnn_fast.stride=3"]).network
    for odd in (
        policy(10**6, network=other),
        replace(policy(2), version=1000, epoch=1000),
        policy(3, task="reaching"),
        replace(policy(4), weights=b"damaged"),
    ):
        setup.publish(odd)
    metrics = setup.wait_for_metrics(lambda metrics: metrics.refused == 4)
    assert metrics.policy_version == 1
    played = metrics.episodes
    setup.wait_for_metrics(lambda metrics: metrics.episodes > played)
    setup.publish(policy(2))
    setup.wait_for_metrics(lambda metrics: metrics.policy_version == 2)


def test_receipts_of_those_who_store_nothing_delete_nothing(setup: ActorSetup) -> None:
    setup.gives_receipts = False
    setup.cases.append(TutoringCase("experiment1", 5, 0))
    setup.start_actor()
    eventually(lambda: len(setup.sequences) >= 1, "a demonstration")
    receipt = Receipt(setup.sequences[0].id)
    key = setup.bus.keys.receipt(Role.LEARNER, "actor-1")
    evaluator = setup.receivers[Role.EVALUATOR]
    hub = HubConfig(endpoint=setup.endpoint)
    with (
        open_bus(hub, "test", Role.WATCH, "stranger") as stranger,
        open_bus(hub, "test", Role.LEARNER, "absent") as absent,
    ):
        evaluator.deliver(setup.bus.keys.receipt(Role.EVALUATOR, "actor-1"), receipt)
        for bus in (stranger, absent, evaluator):
            bus.deliver(key, receipt)
        metrics = setup.wait_for_metrics(lambda metrics: metrics.refused == 3)
    assert metrics.outbox == 1
    setup.bus.deliver(key, receipt)
    setup.wait_for_metrics(lambda metrics: metrics.outbox == 0)


def test_an_actor_whose_folder_ends_with_it_waits_for_receipts_before(setup: ActorSetup) -> None:
    setup.gives_receipts = False
    setup.cases.append(TutoringCase("experiment1", 5, 0))
    setup.start_actor("--drain", "60")
    eventually(lambda: len(setup.sequences) >= 1, "a demonstration")
    setup.actor.terminate()
    setup.cases.append(TutoringCase("experiment1", 6, 0))
    before = len(setup.sequences)
    eventually(lambda: len(setup.sequences) > before, "it is sent again")
    assert setup.actor.poll() is None
    setup.gives_receipts = True
    assert setup.actor.wait(60) == 0
    assert {episode.seed for episode in setup.sequences} == {5000}, "it plays no more"
    assert not list(setup.outbox.rglob("*.message"))


def test_a_killed_actor_sends_messages_without_receipt_again(setup: ActorSetup) -> None:
    setup.gives_receipts = False
    setup.cases.append(TutoringCase("experiment1", 5, 0))
    setup.start_actor()
    eventually(lambda: len(setup.sequences) == 1, "a demonstration")
    setup.actor.kill()
    setup.actor.wait()
    setup.gives_receipts = True
    setup.start_actor()
    eventually(lambda: len(setup.sequences) == 2, "the same once more")
    first, again = setup.sequences
    assert first.id == again.id
    assert np.array_equal(first.actions, again.actions)
    setup.wait_for_metrics(lambda metrics: metrics.outbox == 0 and metrics.episodes == 0)


def test_the_newest_of_several_policies_is_used(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    setup.cases.append(TutoringCase("experiment1", 5, 0))
    setup.start_actor()
    eventually(lambda: bool(setup.lives), "a demonstration is going on")
    setup.publish(policy(3))
    setup.publish(policy(2))
    setup.wait_for_metrics(lambda metrics: metrics.policy_version > 0)
    eventually(lambda: len(setup.rollouts) >= 2, "it practises")
    assert {rollout.episode.policy_version for rollout in setup.rollouts} == {3}


def test_first_trials_of_each_policy_come_before_a_newer_one(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    setup.cases.append(TutoringCase("experiment1", 5, 0))
    setup.first_trials = {1: [Trial(1, 70), Trial(1, 71)], 2: [], 3: [Trial(3, 70)]}
    setup.start_actor("--set", "evaluator.first_trials=2", "--set", "actor.practice=false")
    eventually(lambda: bool(setup.lives), "a demonstration is going on")
    for version in (1, 2, 3, 4):
        setup.publish(policy(version))
    setup.wait_for_metrics(lambda metrics: metrics.policy_version == 4)
    eventually(lambda: len(setup.rollouts) == 3, "all trials are played")
    played = [(r.episode.policy_version, r.episode.seed) for r in setup.rollouts]
    assert played == [(1, 70), (1, 71), (3, 70)]


def test_it_plays_trials_of_earlier_policies_that_it_has_passed_over(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    setup.cases.append(TutoringCase("experiment1", 5, 0))
    setup.start_actor("--set", "actor.practice=false")
    eventually(lambda: bool(setup.lives), "a demonstration is going on")
    for version in (1, 2, 3):
        setup.publish(policy(version))
    setup.wait_for_metrics(lambda metrics: metrics.policy_version == 3)
    eventually(lambda: bool(setup.trial_requests), "it asks for a trial")
    asked = setup.trial_requests[-1]
    assert (asked.policy_version, asked.older) == (3, (1, 2))
    setup.trials += [Trial(2, 70), Trial(9, 71), Trial(1, 72), Trial(3, 73)]
    eventually(lambda: len(setup.rollouts) == 3, "all trials of policies that it has are played")
    played = [(r.episode.policy_version, r.episode.seed) for r in setup.rollouts]
    assert played == [(2, 70), (1, 72), (3, 73)]
    assert "this actor does not have policy 9" in setup.log.read_text()
    setup.publish(policy(1, run_id="new-training"))
    setup.wait_for_metrics(lambda metrics: metrics.policy_version == 1)
    eventually(lambda: setup.trial_requests[-1].run_id == "new-training", "it asks again")
    assert setup.trial_requests[-1].older == ()


def test_a_refused_message_is_put_aside_and_delays_no_others(setup: ActorSetup) -> None:
    setup.refusal = "of another run"
    setup.cases.append(TutoringCase("experiment1", 5, 0))
    setup.start_actor()
    metrics = setup.wait_for_metrics(lambda metrics: metrics.put_aside == 1)
    assert (metrics.outbox, metrics.failed) == (0, 0)
    assert [path.suffix for path in setup.outbox.glob("*/*")] == [".refused"]
    assert "was refused: of another run" in setup.log.read_text()
    setup.refusal = ""
    setup.cases.append(TutoringCase("experiment1", 6, 0))
    setup.wait_for_metrics(
        lambda metrics: metrics.episodes == 2 and metrics.outbox == 0 and metrics.put_aside == 1
    )
    assert [episode.seed for episode in setup.sequences] == [5000, 6000]


def test_messages_of_another_version_delay_no_others(setup: ActorSetup) -> None:
    (setup.outbox / "sequences").mkdir(parents=True)
    key = setup.bus.keys.sequence("actor-1")
    header = {"key": key, "encoding": "application/msgpack;vmdnn.sequence.1"}
    for number in range(IN_FLIGHT + 1):
        path = setup.outbox / "sequences" / f"{number}-old{number}.message"
        path.write_bytes(json.dumps(header).encode() + b"\nanything")
    setup.cases.append(TutoringCase("experiment1", 5, 0))
    setup.start_actor()
    eventually(lambda: len(setup.sequences) == 1, "the new sequence arrives")
    setup.wait_for_metrics(
        lambda metrics: metrics.episodes == 1 and metrics.outbox == IN_FLIGHT + 1
    )
    assert setup.bus.refused >= IN_FLIGHT


def test_a_failed_simulation_is_reported_to_learner_and_evaluator(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    situation = dict(TASK.sample(3))
    setup.cases += [TutoringCase("experiment1", 5, 0), TutoringCase("experiment1", 6, 1)]
    setup.start_actor(
        *("--set", "simulator.backend=tests.failing_simulator:FailingSimulator"),
        *("--set", "actor.practice=false"),
    )
    eventually(lambda: len(setup.failures) == 1, "the second demonstration fails")
    shown = setup.failures[0]
    assert (shown.actor, shown.kind, shown.seed) == ("actor-1", Kind.TUTORING, 6001)
    assert (shown.training, shown.policy_version) == ("", 0)
    assert dict(shown.situation) == dict(TASK.tutored()[6])
    assert "NaN" in shown.problem

    setup.publish(policy(4))
    eventually(lambda: setup.holds("training", 4), "it holds it")
    setup.cases.append(Correction("experiment1", 3, situation))
    setup.trials.append(Trial(4, 80, Conditions("noisy", 1.0, "noisy", 9.0)))
    eventually(lambda: len(setup.failures) == 3, "a correction and a trial fail")
    by_kind = {report.kind: report for report in setup.failures}
    assert by_kind[Kind.CORRECTION].seed == 3
    assert by_kind[Kind.TRIAL].seed == 80
    assert by_kind[Kind.TRIAL].conditions == Conditions("noisy", 1.0, "noisy", 9.0)
    for kind in (Kind.CORRECTION, Kind.TRIAL):
        assert (by_kind[kind].training, by_kind[kind].policy_version) == ("training", 4)
    metrics = setup.wait_for_metrics(lambda metrics: metrics.outbox == 0 and metrics.failed == 3)
    assert metrics.episodes == 1
    assert [episode.seed for episode in setup.sequences] == [5000]
    assert setup.actor.poll() is None


def test_an_episode_that_kills_the_actor_is_reported_by_the_next_one(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    words = ("--set", "simulator.backend=tests.deadly_simulator:DeadlySimulator")
    setup.cases += [TutoringCase("experiment1", 5, 0), TutoringCase("experiment1", DEADLY_CASE, 0)]
    setup.start_actor(*words)
    setup.actor.wait(PATIENCE_S)
    assert setup.failures == []
    assert [path.suffix for path in setup.outbox.glob("*/*")] == [".prepared"]
    setup.publish(policy(4))
    setup.start_actor(*words, "--set", "actor.practice=false")
    eventually(lambda: len(setup.failures) == 1, "the case is reported")
    eventually(lambda: setup.holds("training", 4), "it holds the policy")
    setup.trials.append(Trial(4, DEADLY_SEED))
    setup.actor.wait(PATIENCE_S)
    setup.start_actor(*words)
    eventually(lambda: len(setup.failures) == 2, "the trial is reported")
    case, trial = setup.failures
    assert (case.kind, case.seed, case.died) == (Kind.TUTORING, 1000 * DEADLY_CASE, True)
    assert (trial.kind, trial.seed, trial.died) == (Kind.TRIAL, DEADLY_SEED, True)
    assert (trial.training, trial.policy_version, trial.actor) == ("training", 4, "actor-1")
    setup.wait_for_metrics(lambda metrics: metrics.outbox == 0)
    setup.actor.kill()
    setup.actor.wait(PATIENCE_S)
    assert [episode.seed for episode in setup.sequences] == [5000]


def test_it_plays_trials_and_practises_under_the_conditions_of_suites(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    conditions = Conditions("pushed", 1.0, "pushed", 20.0)
    unknown = Conditions("mine", 1.0, "darker", 20.0)
    setup.trials += [Trial(1, 500, conditions), Trial(1, 501, unknown)]
    setup.publish(policy(1))
    suites = "evaluator.suites=[{name: pushed, trials: 5}, {name: elsewhere, backend: other}]"
    corrections = "learner.corrections={rounds: 1, suites: [pushed, elsewhere]}"
    setup.start_actor("--set", suites, "--set", corrections)
    eventually(lambda: len(setup.rollouts) >= 3, "two trials, then practice")
    trial, mine, practice = (rollout.episode for rollout in setup.rollouts[:3])
    assert (trial.kind, trial.seed, trial.conditions) == (Kind.TRIAL, 500, conditions)
    assert (mine.kind, mine.seed, mine.conditions) == (Kind.TRIAL, 501, unknown)
    assert dict(trial.situation) == dict(TASK.sample(500))
    suite = load_config(None, [suites]).suite("pushed")
    assert practice.kind is Kind.PRACTICE
    assert practice.seed in suite.practice_seeds
    assert practice.conditions == suite.conditions(practice.seed)


def test_nothing_is_lost_while_there_is_no_hub(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    setup.publish(policy(1))
    setup.start_actor("--set", "actor.live=false")
    eventually(lambda: len(setup.rollouts) >= 1, "a rollout")
    setup.hub.kill()
    setup.hub.wait()
    eventually(
        lambda: len(list(setup.outbox.glob("*/*.message"))) >= 2, "it plays on without a hub"
    )
    setup.start_hub()
    eventually(lambda: setup.command(Command.PAUSE) == ["paused"], "it replies again")
    metrics = setup.wait_for_metrics(lambda metrics: metrics.paused and metrics.outbox == 0)
    arrived = {rollout.episode.id for rollout in setup.rollouts}
    assert len(arrived) == metrics.episodes
    assert list(setup.outbox.glob("*/*")) == []
    assert setup.actor.poll() is None


def test_when_stopped_it_aborts_its_episode_and_ends_cleanly(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    setup.publish(policy(1))
    # Without the stop an episode would take many hours.
    setup.start_actor("--set", "simulator.physics_period_s=0.00001")
    eventually(lambda: len(setup.lives) >= 1, "it plays")
    assert stop(setup.actor) == 0
    assert setup.rollouts == []
    assert setup.bus.present(Role.ACTOR) == set()


@pytest.mark.parametrize("recorded", [True, False])
def test_old_rollouts_go_to_recorders_and_their_outcomes_to_the_evaluator(
    setup: ActorSetup, make_episode: MakeEpisode, recorded: bool
) -> None:
    """Former versions sent them to the evaluator as well."""
    left = Outbox(setup.outbox / "rollouts", lambda *_: None)
    receivers = [Role.EVALUATOR, Role.RECORDER] if recorded else [Role.EVALUATOR]
    for number in range(2 * IN_FLIGHT):  # more than are sent before the first receipts come
        episode = make_episode(20, id=f"old-{number}", actor="actor-1", training="training")
        message = Rollout(replace(episode, kind=Kind.TRIAL), "training")
        left.add(episode.id, setup.bus.keys.rollout("actor-1"), encode(message), receivers)
    setup.start_actor()
    setup.wait_for_metrics(lambda metrics: metrics.outbox == 0)
    ids = {f"old-{number}" for number in range(2 * IN_FLIGHT)}
    assert {outcome.id for outcome in setup.outcomes} == ids
    assert {rollout.episode.id for rollout in setup.rollouts} == (ids if recorded else set())


def test_a_share_of_the_precise_episodes_is_recorded_and_all_others(
    make_episode: MakeEpisode,
) -> None:
    def is_recorded(episode: Episode, config: RecorderConfig) -> bool:
        practice = episode.kind is Kind.PRACTICE
        return config.records(episode.id, practice=practice, precise=episode.outcome.precise)

    few = RecorderConfig(share=0.25)
    precise = [make_episode(2, id=f"{n}", kind=Kind.TRIAL, outcome=PRECISE) for n in range(400)]
    assert 60 < sum(is_recorded(episode, few) for episode in precise) < 140
    assert all(is_recorded(episode, RecorderConfig()) for episode in precise)
    assert not any(is_recorded(episode, RecorderConfig(share=0.0)) for episode in precise)
    failed = [replace(episode, outcome=NOT_LIFTED) for episode in precise]
    assert all(is_recorded(episode, RecorderConfig(share=0.0)) for episode in failed)
    practice = replace(failed[0], kind=Kind.PRACTICE)
    assert not is_recorded(practice, RecorderConfig(practice=False))


def leave_sequences(setup: ActorSetup, make_episode: MakeEpisode, actor: str) -> None:
    """Put sequences into an actor's outbox, with the keys of a run of another name."""
    left = Outbox(setup.outbox.parent / actor / "sequences", lambda *_: None)
    for number in range(IN_FLIGHT):
        episode = make_episode(20, id=f"{actor}-{number}", actor=actor)
        key = Keys("former-name").sequence(actor)
        left.add(episode.id, key, encode(Sequence(episode)), [Role.LEARNER])


def test_what_a_renamed_run_left_in_its_outboxes_arrives(
    setup: ActorSetup, make_episode: MakeEpisode
) -> None:
    leave_sequences(setup, make_episode, "actor-1")
    setup.start_actor()
    setup.wait_for_metrics(lambda metrics: metrics.outbox == 0)
    assert len({episode.id for episode in setup.sequences}) == IN_FLIGHT
    assert not list(setup.outbox.glob("*/*"))


def test_an_actor_sends_what_actors_left_that_are_gone_for_good(
    setup: ActorSetup, make_episode: MakeEpisode
) -> None:
    leave_sequences(setup, make_episode, "gone-1")
    run_folder = setup.outbox.parents[1]
    config = HubConfig(endpoint=setup.endpoint)
    with open_bus(config, "test", Role.ACTOR, "another-1") as bus:
        receipts = Receipts(bus)
        waits = LeftOutboxes(run_folder, bus, receipts)
        waits.look()
        assert len(waits) == 0, "it may come back"
        left = LeftOutboxes(run_folder, bus, receipts, gone_after_s=0.0)
        with own_id(run_folder, Role.ACTOR, "gone-1"):
            left.look()
            assert len(left) == 0, "it is about to come back"
        left.look()
        with own_id(run_folder, Role.ACTOR, "gone-1"):
            pass  # it can come back even now

        def all_sent() -> bool:
            left.look()
            return len(left) == 0 and len(setup.sequences) >= IN_FLIGHT

        eventually(all_sent, "all receipts have come")
        left.close()
    assert not list((run_folder / "outbox" / "gone-1").glob("*/*"))


def test_a_rollout_stays_until_the_recorder_has_it_too(
    setup: ActorSetup, policy: Callable[..., PolicyVersion]
) -> None:
    setup.recorders.clear()
    setup.trials.append(Trial(1, 1234))
    setup.publish(policy(1))
    setup.start_actor("--set", "actor.practice=false")
    eventually(lambda: len(setup.rollouts) == 1, "a trial")
    eventually(lambda: len(setup.rollouts) == 2, "it is sent again")
    metrics = setup.wait_for_metrics(lambda metrics: bool(metrics.waiting_for))
    assert (metrics.outbox, metrics.waiting_for) == (1, "receipts of the recorder")
    assert [outcome.id for outcome in setup.outcomes] == [setup.rollouts[0].episode.id]
    assert setup.outcomes[0] == EpisodeOutcome.of(setup.rollouts[0].episode)
    setup.recorders.append(Role.RECORDER)
    setup.wait_for_metrics(lambda metrics: metrics.outbox == 0)


def test_an_actor_of_a_run_that_nobody_serves_says_so(tmp_path: Path) -> None:
    endpoint, log = free_endpoint(), tmp_path / "actor.log"
    words = (
        *("--connect", endpoint, "--set", f"run.folder={tmp_path}", "--set", "run.name=lonely"),
        *("--set", "simulator.render=false"),
    )
    with listening_hub(endpoint), vmdnn("actor", *words, log=log):
        said = "waiting for a learner or an evaluator of the run lonely: nobody serves it (since 5"
        eventually(lambda: said in log.read_text(), "it says that nobody serves the run")
