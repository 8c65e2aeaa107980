"""The actor as a process: plays what is asked for, physics only, and loses nothing."""

from __future__ import annotations

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
from ports import free_endpoint
from processes import eventually, listening_hub, run_vmdnn, stop, vmdnn

from actors.tasks.experiment1.plan import plan
from actors.tasks.registry import make_task
from learner.training.trainer import Trainer
from learner.training.vmdnn_recipe import VMDNNRecipe
from learner.tutoring.store import TutoringStore
from proto.bus import Bus, open_bus
from proto.config import Config, HubConfig, LearnerConfig, PretrainingConfig, TaskConfig
from proto.episode import Episode, Kind
from proto.keys import Role
from proto.messages import (
    Command,
    Control,
    ControlReply,
    Correction,
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
from proto.seeds import PRACTICE

MakeEpisode = Callable[..., Episode]
TASK = make_task(TaskConfig())


@pytest.fixture(scope="module")
def policy(
    make_episode: MakeEpisode, tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., PolicyVersion]:
    """Make a policy version of a network that was hardly trained."""
    store = TutoringStore(tmp_path_factory.mktemp("tutoring"))
    store.add(make_episode(20, kind=Kind.TUTORING, situation=dict(TASK.tutored()[0])))
    config = Config(learner=LearnerConfig(pretraining=PretrainingConfig(epochs=0)))
    trainer = Trainer(VMDNNRecipe(config, TASK.questions), store)
    trainer.epoch()

    def make(version: int, run_id: str = "training") -> PolicyVersion:
        return PolicyVersion(run_id, version, 1, 0.5, "digest", trainer.policy_bytes(version))

    return make


class Theatre:
    """A hub, an actor, and a session that acts as learner and evaluator."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._stack = stack
        self.outbox = folder / "test" / "outbox" / "mime"
        self.log = folder / "actor.log"
        self.endpoint = free_endpoint()
        self.words = (
            *("--connect", self.endpoint, "--set", f"run.folder={folder}"),
            *("--set", "run.name=test", "--set", "simulator.render=false"),
        )
        self.cases: list[TutoringCase | Correction] = []
        self.requests: list[TutoringRequest] = []
        self.trials: list[Trial] = []
        self.sequences: list[Episode] = []
        self.rollouts: list[Rollout] = []
        self.lives: list[Live] = []
        self.told: ActorMetrics | None = None
        self.gives_receipts = True
        self.hub: Popen[bytes]
        self.actor: Popen[bytes]
        self.start_hub()
        self.bus: Bus = stack.enter_context(
            open_bus(HubConfig(endpoint=self.endpoint), "test", Role.LEARNER, "director")
        )
        self._lock = threading.Lock()
        keys = self.bus.keys
        self.bus.answer(keys.request_tutoring, TutoringRequest, self._on_request)
        self.bus.answer(keys.request_trial, TrialRequest, lambda _: self._next(self.trials))
        self.bus.subscribe(keys.sequence(), self._on_sequence, Sequence)
        self.bus.subscribe(keys.rollout(), self._on_rollout, Rollout)
        self.bus.subscribe(keys.live(), self.lives.append, Live)
        self.bus.subscribe(keys.metrics(Role.ACTOR), self._on_metrics, ActorMetrics)

    def start_hub(self) -> None:
        self.hub = self._stack.enter_context(listening_hub(self.endpoint))

    def start_actor(self, *more: str) -> None:
        self.told = None
        words = (*self.words, "--id", "mime", *more)
        self.actor = self._stack.enter_context(vmdnn("actor", *words, log=self.log))

    def publish(self, policy: PolicyVersion) -> None:
        self.bus.publish_newest(self.bus.keys.policy, policy)

    def tells(self, what: Callable[[ActorMetrics], bool]) -> ActorMetrics:
        eventually(lambda: self.told is not None and what(self.told), "the metrics it should tell")
        assert self.told is not None
        return self.told

    def command(self, command: Command) -> list[str]:
        control = self.bus.keys.control(Role.ACTOR)
        return [r.note for r in self.bus.ask(control, Control(command), ControlReply)]

    def _on_request(self, request: TutoringRequest) -> object | None:
        self.requests.append(request)
        return self._next(self.cases)

    def _next(self, things: list[Any]) -> object | None:
        with self._lock:
            return things.pop(0) if things else None

    def _on_sequence(self, sequence: Sequence) -> None:
        self.sequences.append(sequence.episode)
        self._acknowledge(sequence.episode)

    def _on_rollout(self, rollout: Rollout) -> None:
        self.rollouts.append(rollout)
        self._acknowledge(rollout.episode)

    def _on_metrics(self, metrics: ActorMetrics) -> None:
        self.told = metrics

    def _acknowledge(self, episode: Episode) -> None:
        if self.gives_receipts:
            self.bus.deliver(self.bus.keys.receipt(episode.actor), Receipt(episode.id))


@pytest.fixture
def theatre(tmp_path: Path) -> Iterator[Theatre]:
    with ExitStack() as stack:
        yield Theatre(stack, tmp_path)


def test_it_shows_cases_plays_trials_and_practises(
    theatre: Theatre, policy: Callable[..., PolicyVersion]
) -> None:
    theatre.cases += [
        TutoringCase("experiment1", 3, 0),
        TutoringCase("experiment1", 99, 0),
        TutoringCase("experiment9", 3, 0),
        TutoringCase("experiment1", 3, 1),
        TutoringCase("reaching", 14, 0),
    ]
    theatre.start_actor()
    eventually(lambda: len(theatre.sequences) == 3, "three demonstrations")
    clean, noisy, reaching = theatre.sequences
    assert (reaching.task, reaching.seed) == ("reaching", 14000)
    assert dict(reaching.situation) == {"object_y_m": 0.30, "object_yaw_deg": 45.0}
    assert "obstacle" not in reaching.body_names
    assert (clean.seed, noisy.seed) == (3000, 3001)
    assert dict(clean.situation) == dict(noisy.situation) == dict(TASK.tutored()[3])
    assert {clean.kind, noisy.kind} == {Kind.TUTORING}
    assert np.array_equal(clean.actions, clean.targets)
    assert not np.array_equal(noisy.actions, noisy.targets)
    assert np.array_equal(noisy.targets, clean.targets)
    told = theatre.tells(lambda told: told.episodes == 3 and told.outbox == 0)
    assert told.policy_version == 0
    assert told.last_kind is Kind.TUTORING
    assert told.last_outcome is reaching.outcome.reason

    theatre.trials.append(Trial(seed=1234))
    theatre.publish(policy(1))
    eventually(lambda: len(theatre.rollouts) >= 2, "a trial, then practice")
    trial, practice = theatre.rollouts[:2]
    assert (trial.run_id, trial.episode.policy_version) == ("training", 1)
    assert (trial.episode.kind, trial.episode.seed) == (Kind.TRIAL, 1234)
    assert dict(trial.episode.situation) == dict(TASK.sample(1234))
    assert trial.episode.outputs is not None
    assert practice.episode.kind is Kind.PRACTICE
    assert practice.episode.seed in PRACTICE

    assert theatre.command(Command.PAUSE) == ["paused"]
    paused = theatre.tells(lambda told: told.paused and told.steps_per_s == 0)
    theatre.cases.append(TutoringCase("experiment1", 0, 0))
    assert theatre.tells(lambda t: t.time_s > paused.time_s + 1).episodes == paused.episodes
    assert theatre.command(Command.RESUME) == ["resumed"]
    eventually(lambda: len(theatre.sequences) == 4, "it plays again")
    assert stop(theatre.actor) == 0


def test_its_policy_is_guided_where_the_learner_says(
    theatre: Theatre, policy: Callable[..., PolicyVersion]
) -> None:
    situation = dict(TASK.sample(3))
    asked = Correction("experiment1", 3, situation)
    theatre.cases.append(asked)  # has no policy yet
    theatre.start_actor("--set", "tutor.guidance_deg=2")
    eventually(lambda: "no policy to be guided" in theatre.log.read_text(), "a warning")
    assert {(r.run_id, r.policy_version) for r in theatre.requests} == {("", 0)}

    theatre.publish(policy(4))
    eventually(lambda: TutoringRequest("mime", "training", 4) in theatre.requests, "it holds it")
    outside = {**situation, "object_y_m": 0.9}
    theatre.cases += [Correction("experiment1", 4, outside), asked]
    eventually(lambda: len(theatre.sequences) == 1, "a correction")
    assert "object_y_m = 0.9 lies outside" in theatre.log.read_text()
    (episode,) = theatre.sequences
    assert (episode.kind, episode.policy, episode.policy_version) == (Kind.CORRECTION, "guided", 4)
    assert (episode.seed, dict(episode.situation)) == (3, situation)
    np.testing.assert_allclose(episode.targets, plan(situation), atol=1e-4)
    off = np.abs(episode.actions - episode.targets)
    assert off.max() <= 2.0 + 1e-4
    assert off.max() > 1.0, "it is the policy that acts"
    theatre.tells(lambda told: told.outbox == 0)


def test_a_policy_changes_between_episodes_only(
    theatre: Theatre, policy: Callable[..., PolicyVersion]
) -> None:
    def acts_with(version: int) -> bool:
        return any(live.policy_version == version for live in list(theatre.lives))

    theatre.publish(policy(1))
    theatre.start_actor()
    eventually(lambda: acts_with(1), "it acts with policy 1")
    theatre.publish(replace(policy(2), weights=b"damaged"))
    eventually(lambda: "policy 2 is not taken" in theatre.log.read_text(), "a warning")
    theatre.publish(policy(3))
    eventually(lambda: acts_with(3), "it acts with policy 3")
    theatre.publish(policy(2))  # late: a version never goes back
    seen_rollouts = len(theatre.rollouts)
    eventually(lambda: len(theatre.rollouts) >= seen_rollouts + 2, "more episodes")
    theatre.publish(policy(1, run_id="new"))  # but a new training begins at 1
    eventually(lambda: any(r.run_id == "new" for r in theatre.rollouts), "the new training")
    theatre.actor.kill()

    seen = [(live.policy_version, live.step) for live in list(theatre.lives)]
    changes = [after for before, after in pairwise(seen) if before[0] != after[0]]
    assert [version for version, _ in changes] == [3, 1]
    assert {step for _, step in changes} == {0}
    versions = [(r.run_id, r.episode.policy_version) for r in list(theatre.rollouts)]
    assert list(dict.fromkeys(versions)) == [("training", 1), ("training", 3), ("new", 1)]


def test_a_killed_actor_sends_again_what_had_no_receipt(theatre: Theatre) -> None:
    theatre.gives_receipts = False
    theatre.cases.append(TutoringCase("experiment1", 5, 0))
    theatre.start_actor()
    eventually(lambda: len(theatre.sequences) == 1, "a demonstration")
    theatre.actor.kill()
    theatre.actor.wait()
    theatre.gives_receipts = True
    theatre.start_actor()
    eventually(lambda: len(theatre.sequences) == 2, "the same once more")
    first, again = theatre.sequences
    assert first.id == again.id
    assert np.array_equal(first.actions, again.actions)
    theatre.tells(lambda told: told.outbox == 0 and told.episodes == 0)


def test_nothing_is_lost_while_the_hub_is_away(
    theatre: Theatre, policy: Callable[..., PolicyVersion]
) -> None:
    theatre.publish(policy(1))
    theatre.start_actor("--set", "actor.live=false")
    eventually(lambda: len(theatre.rollouts) >= 1, "a rollout")
    theatre.hub.kill()
    theatre.hub.wait()
    eventually(
        lambda: len(list(theatre.outbox.glob("*/*.message"))) >= 2, "it plays on without a hub"
    )
    theatre.start_hub()
    eventually(lambda: theatre.command(Command.PAUSE) == ["paused"], "it is back")
    told = theatre.tells(lambda told: told.paused and told.outbox == 0)
    arrived = {rollout.episode.id for rollout in theatre.rollouts}
    assert len(arrived) == told.episodes
    assert list(theatre.outbox.glob("*/*")) == []
    assert theatre.actor.poll() is None


def test_told_to_stop_it_gives_up_its_episode_and_ends_cleanly(
    theatre: Theatre, policy: Callable[..., PolicyVersion]
) -> None:
    theatre.publish(policy(1))
    # an episode of many hours, were it not for the stop
    theatre.start_actor("--set", "simulator.physics_period_s=0.00001")
    eventually(lambda: len(theatre.lives) >= 1, "it plays")
    assert stop(theatre.actor) == 0
    assert theatre.rollouts == []
    assert theatre.bus.present(Role.ACTOR) == set()


def test_without_a_hub_it_says_what_to_do(tmp_path: Path) -> None:
    words = ("--connect", free_endpoint(), "--set", f"run.folder={tmp_path}")
    ended = run_vmdnn("actor", *words)
    assert ended.returncode == 2
    assert "start one with `vmdnn hub`" in ended.stderr
    assert "Traceback" not in ended.stderr
