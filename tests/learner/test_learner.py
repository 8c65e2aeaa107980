"""The learner as a process requests and stores sequences, trains, publishes, and restarts."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from subprocess import Popen

import numpy as np
import pytest
from fitting import fitting_fields, settings_digest
from outcomes import NOT_LIFTED
from ports import free_endpoint
from processes import eventually, listening_hub, run_vmdnn, stop, vmdnn

from actors.tasks.registry import make_task
from learner.checkpoint import (
    checkpoint_from_bytes,
    load_checkpoint,
    pretraining_file,
    training_file,
)
from learner.network_policy import NetworkPolicy
from learner.tutoring.failures import TRIES
from proto.bus import Bus, open_bus
from proto.config import HubConfig, TaskConfig
from proto.episode import Episode, Kind
from proto.keys import Role
from proto.messages import (
    Command,
    Control,
    ControlReply,
    Correction,
    EpisodeFailed,
    PolicyVersion,
    Receipt,
    Sequence,
    TutoringCase,
    TutoringRequest,
    Verdict,
)
from proto.metrics import EpochMetrics, LearnerMetrics, Stage
from proto.recordings.episodes import read_episode, write_episode
from proto.suites import Player

MakeEpisode = Callable[..., Episode]
SETTINGS = {
    "run.name": "test",
    "tutor.repeats": 1,
    "learner.cases": [0, 20, 44],
    "learner.start_sequences": 45,
    "learner.pretraining.task": "null",
    "learner.pretraining.epochs": 2,
    "learner.epochs": 400,
    "learner.publish_every_epochs": 5,
    "learner.checkpoint_every_epochs": 7,
    "done.policy_versions": 3,
}
LONG = ("--set", "learner.epochs=1000000")
"""A training that has not finished when it is killed."""


FAILED = NOT_LIFTED
SAPIEN = Player("sapien")


def case(number: int, repeat: int, task: str = "experiment1") -> TutoringCase:
    return TutoringCase(task, number, repeat)


class LearnerSetup:
    """A hub, a learner, and a session that plays the role of an actor."""

    def __init__(self, stack: ExitStack, folder: Path, make_episode: MakeEpisode) -> None:
        self._stack = stack
        self._make_episode = make_episode
        self.folder = folder / "test"
        self.settings = [f"{key}={value}" for key, value in SETTINGS.items()]
        self.endpoint = free_endpoint()
        self.words = ["--connect", self.endpoint, "--set", f"run.folder={folder}"]
        for key, value in SETTINGS.items():
            self.words += ["--set", f"{key}={value}"]
        stack.enter_context(listening_hub(self.endpoint))
        self.actor = self.join("actor")
        self.evaluator = self.join("evaluator", Role.EVALUATOR)
        self.actor.announce()
        self.policies: list[PolicyVersion] = []
        self.metrics: LearnerMetrics | None = None
        self.epochs: list[EpochMetrics] = []
        self._receipts: list[Receipt] = []
        keys = self.actor.keys
        self.actor.subscribe_newest(keys.policy, self.policies.append, PolicyVersion)
        self.actor.subscribe(keys.metrics(Role.LEARNER), self._listen, LearnerMetrics)
        self.actor.subscribe(keys.receipt(Role.LEARNER, "actor"), self._receipts.append, Receipt)
        self.process: Popen[bytes]

    def start(self, *more: str) -> None:
        self.metrics = None
        self.process = self._stack.enter_context(vmdnn("learner", *self.words, *more))

    def join(self, name: str, role: Role = Role.ACTOR) -> Bus:
        bus = open_bus(HubConfig(endpoint=self.endpoint), "test", role, name)
        return self._stack.enter_context(bus)

    def ask(self) -> list[TutoringCase | Correction]:
        """Send a request as an actor that has the newest policy."""
        newest = [(policy.run_id, policy.version) for policy in self.policies[-1:]]
        policy = newest[0] if newest else ("", 0)
        request = TutoringRequest("actor", *policy, settings_digest(*self.settings), SAPIEN)
        key = self.actor.keys.request_tutoring
        answers: list[TutoringCase | Correction]
        answers = self.actor.ask(key, request, TutoringCase, Correction)
        return answers

    def ask_until_given(self) -> TutoringCase | Correction:
        given: list[TutoringCase | Correction] = []

        def asked() -> bool:
            given.extend(self.ask())
            return bool(given)

        eventually(asked, "something to show")
        return given[0]

    def correction(self, asked: Correction, **fields: object) -> Episode:
        given = {
            **fitting_fields(asked.task, *self.settings),
            "id": f"corrected{asked.seed}",
            "seed": asked.seed,
            "situation": dict(asked.situation),
            "policy_version": self.policies[-1].version,
            "training": self.policies[-1].run_id,
            **fields,
        }
        steps = len(given["phases"])
        return self._make_episode(steps, kind=Kind.CORRECTION, actor="actor", **given)

    def fail_in_practice(self, seed: int) -> Correction:
        """Report a failure of practice until the learner requests a correction there."""
        task, newest = make_task(TaskConfig()), self.policies[-1]
        policy = {"run_id": newest.run_id, "policy_version": newest.version, "task": task.name}
        policy["backend"] = "sapien"
        verdict = Verdict(seed=seed, situation=task.sample(seed), outcome=FAILED, **policy)
        asked: list[TutoringCase | Correction] = []

        def heard() -> bool:
            self.evaluator.deliver(self.actor.keys.verdict, verdict)
            asked.extend(self.ask())
            return bool(asked)

        eventually(heard, "a correction is asked for")
        assert isinstance(asked[0], Correction)
        return asked[0]

    def episode(self, shown: TutoringCase, **fields: object) -> Episode:
        task = make_task(TaskConfig.model_validate({"name": shown.task}))
        given = {
            **fitting_fields(shown.task, *self.settings),
            "id": f"case{shown.case}",
            "seed": shown.seed,
            "situation": dict(task.tutored()[shown.case]),
            **fields,
        }
        steps = len(given["phases"])
        return self._make_episode(steps, kind=Kind.TUTORING, actor="actor", **given)

    def send(self, episode: Episode) -> str:
        """Send a sequence until its receipt arrives; return the refusal, empty if accepted."""
        return self._send(episode.id, self.actor.keys.sequence("actor"), Sequence(episode))

    def fail(self, report: EpisodeFailed) -> str:
        """Report a failed simulation until its receipt arrives; return the refusal."""
        return self._send(report.id, self.actor.keys.failure("actor"), report)

    def _send(self, name: str, key: str, message: object) -> str:
        self._receipts.clear()

        def answers() -> list[Receipt]:
            return [receipt for receipt in list(self._receipts) if receipt.episode == name]

        def answered() -> bool:
            self.actor.deliver(key, message)
            return bool(answers())

        eventually(answered, "an answer")
        return answers()[0].refusal

    def show_all(self) -> None:
        for number in SETTINGS["learner.cases"]:  # type: ignore[attr-defined]
            assert self.send(self.episode(case(number, 0))) == ""

    def wait_for_metrics(self, ready: Callable[[LearnerMetrics], bool]) -> LearnerMetrics:
        """Wait until the newest metrics satisfy `ready`."""
        eventually(lambda: self.metrics is not None and ready(self.metrics), "the expected metrics")
        assert self.metrics is not None
        return self.metrics

    def _listen(self, metrics: LearnerMetrics) -> None:
        self.metrics = metrics
        self.epochs += metrics.epochs


@pytest.fixture
def setup(tmp_path: Path, make_episode: MakeEpisode) -> Iterator[LearnerSetup]:
    with ExitStack() as stack:
        yield LearnerSetup(stack, tmp_path, make_episode)


def test_it_requests_each_case_once_and_stores_the_sequences(setup: LearnerSetup) -> None:
    setup.start()
    given = [setup.ask_until_given(), *setup.ask(), *setup.ask(), *setup.ask()]
    assert given == [case(number, 0) for number in (0, 20, 44)]
    metrics = setup.wait_for_metrics(lambda metrics: metrics.stage is Stage.WAITING)
    assert (metrics.sequences, metrics.loss, metrics.policy_version) == (0, None, 0)

    episode = setup.episode(given[0])
    assert setup.send(episode) == setup.send(episode) == ""
    assert setup.send(setup.episode(given[0], id="the-same-case-of-another-actor")) == ""
    nobodys = setup.send(setup.episode(case(7, 0), id="a-case-nobody-asked-for"))
    assert nobodys == "no tutored case of experiment1 with the seed 7000 is asked for"
    other_task = setup.send(setup.episode(given[1], task="experiment9", id="another-task"))
    assert other_task == "this run learns experiment1, not experiment9"
    practice = setup.send(replace(episode, kind=Kind.PRACTICE, id="no-demonstration"))
    assert practice == "nothing is learned from an episode of the kind practice"
    setup.wait_for_metrics(lambda metrics: metrics.sequences == 1)
    kept = list((setup.folder / "tutoring").iterdir())
    assert [path.name for path in kept] == ["case0.mcap"]
    sent = setup.episode(given[0])
    assert np.array_equal(read_episode(kept[0]).images, sent.images)

    # what was shown is not asked for again, what the actor took with it is
    setup.process.kill()
    setup.process.wait()
    setup.start()
    assert setup.ask_until_given() == case(20, 0)
    assert stop(setup.process) == 0


def test_sequences_that_do_not_fit_are_refused_and_a_poisoned_folder_is_cleared(
    setup: LearnerSetup,
) -> None:
    setup.start()
    shown = setup.ask_until_given()
    assert isinstance(shown, TutoringCase)
    fine = setup.episode(shown)
    one_step = {
        name: getattr(fine, name)[:1]
        for name in ("images", "actions", "targets", "joints_deg", "phases", "body_poses")
    } | {"outputs": None}
    outside = {**fine.situation, "object_y_m": 1e12}
    for name, wrong, problem in (
        ("one-step", one_step, "it has 1 steps"),
        ("nowhere", {"situation": {}}, "its situation is not the one of the seed 0"),
        ("outside", {"situation": outside}, "its situation is not the one of the seed 0"),
        ("foreign", {"config_digest": "other"}, "its configuration is not that of this run"),
        ("too-far", {"actions": fine.actions - 100}, "not within what the robot accepts"),
        ("phases", {"phases": np.zeros_like(fine.phases)}, "its phases are not those"),
        ("too-late", {"seed": 2**60}, "no tutored case"),
    ):
        assert problem in setup.send(replace(fine, id=name, **wrong))
    assert setup.send(fine) == ""
    same_id = setup.send(replace(setup.episode(case(20, 0)), id=fine.id))
    assert same_id == "another sequence with this id is stored"
    metrics = setup.wait_for_metrics(lambda metrics: metrics.sequences == 1)
    assert metrics.stage is Stage.WAITING
    assert metrics.refused >= 8, "messages are sent until they are answered"

    setup.process.kill()
    setup.process.wait()
    folder = setup.folder / "tutoring"
    poison = setup.episode(case(20, 0))
    write_episode(folder / "p1.mcap", replace(poison, id="p1", situation={}))
    write_episode(folder / "p2.mcap", replace(poison, targets=poison.targets * 1e12, id="../p2"))
    short = setup.episode(case(20, 0), **one_step)
    write_episode(folder / "p3.mcap", replace(short, id="p3"))
    setup.start()
    assert setup.ask_until_given() == case(20, 0), "it is still missing"
    metrics = setup.wait_for_metrics(lambda metrics: metrics.sequences == 1)
    assert metrics.damaged == 3
    assert {path.name for path in folder.iterdir()} == {
        *("case0.mcap", "p1.refused", "p2.refused", "p3.refused")
    }
    assert stop(setup.process) == 0


def test_pretraining_has_its_own_cases_and_does_not_wait_for_the_others(
    setup: LearnerSetup,
) -> None:
    asked = {"task": "reaching", "cases": "[0,14]", "repeats": 1, "epochs": 3}
    words = [f"--set=learner.pretraining.{name}={value}" for name, value in asked.items()]
    setup.settings.append("learner.pretraining.task=reaching")
    setup.start(*words, "--set", "learner.publish_every_epochs=400")
    first, second = case(0, 0, "reaching"), case(14, 0, "reaching")
    assert [setup.ask_until_given(), *setup.ask(), *setup.ask()] == [first, second, case(0, 0)]
    setup.send(setup.episode(case(0, 0)))
    setup.send(setup.episode(first, id="reaching0"))
    assert setup.wait_for_metrics(lambda metrics: metrics.sequences == 2).stage is Stage.WAITING

    setup.send(setup.episode(second, id="reaching14"))
    formed = pretraining_file(setup.folder)
    eventually(formed.exists, "pre-training is over")

    def told() -> bool:
        epochs = [each for each in setup.epochs if each.stage is Stage.PRETRAINING]
        return [each.epoch for each in epochs] == [1, 2, 3] and epochs[0].loss > 0

    eventually(told, "the metrics have told each epoch once")
    metrics = setup.wait_for_metrics(
        lambda metrics: metrics.stage is Stage.WAITING and metrics.epoch == 3
    )
    assert (metrics.epochs_total, metrics.sequences) == (3, 3)
    checkpoint = load_checkpoint(formed)
    assert checkpoint.metadata.stage is Stage.PRETRAINING
    training = checkpoint.metadata.training
    assert training is not None
    assert training.sequences == ("reaching0", "reaching14")
    assert set(training.asked) == {"object_y_m", "object_yaw_deg"}
    assert checkpoint.part("classifier.")["weight"].shape == (3 + 5, 20)

    # It continues with the other sequences when they have arrived, also after a restart.
    setup.process.kill()
    setup.process.wait()
    setup.start(*words, "--set", "learner.publish_every_epochs=400")
    setup.show_all()
    setup.wait_for_metrics(lambda metrics: metrics.stage is Stage.FINISHED)
    assert stop(setup.process) == 0
    kept = {path.stem for path in (setup.folder / "pretraining").iterdir()}
    assert kept == {"reaching0", "reaching14"}
    tutored = {path.stem for path in (setup.folder / "tutoring").iterdir()}
    assert tutored == {"case0", "case20", "case44"}


def test_a_killed_learner_publishes_its_policy_again_and_continues(setup: LearnerSetup) -> None:
    setup.start(*LONG)
    setup.show_all()
    eventually(lambda: len(setup.policies) >= 3, "three policies")
    setup.process.kill()
    setup.process.wait()
    before = list(setup.policies)
    assert [policy.version for policy in before] == list(range(1, len(before) + 1))
    assert [policy.epoch for policy in before] == [5 * policy.version for policy in before]
    policy = NetworkPolicy.from_bytes(before[-1].weights)
    assert policy.version == before[-1].version
    assert policy.step(np.zeros((48, 64), np.uint8)).shape == (11,)

    # it may have saved one more than anyone heard of before it was killed
    known = load_checkpoint(training_file(setup.folder)).metadata.version
    assert known in {before[-1].version, before[-1].version + 1}

    setup.policies.clear()
    setup.start(*LONG)
    eventually(lambda: len(setup.policies) >= 3, "policies after the restart")
    again = setup.policies[0]
    assert again.version == known
    if known == before[-1].version:
        assert again == before[-1]
    assert {policy.run_id for policy in setup.policies} == {before[0].run_id}
    versions = [policy.version for policy in setup.policies]
    assert versions == list(range(again.version, again.version + len(versions)))
    assert [policy.epoch for policy in setup.policies] == [5 * version for version in versions]
    assert setup.ask() == [], "everything was shown before"
    setup.wait_for_metrics(lambda metrics: metrics.done and metrics.sequences == 3)


def test_its_policy_is_corrected_where_it_fails_and_training_continues(setup: LearnerSetup) -> None:
    corrections = {"rounds": 1, "sequences": 3, "tries": 5, "epochs": 4}
    words = [f"--set=learner.corrections.{name}={value}" for name, value in corrections.items()]
    words += ["--set", "learner.epochs=6", "--set", "done.policy_versions=3"]
    setup.start(*words)
    setup.show_all()
    metrics = setup.wait_for_metrics(
        lambda metrics: metrics.stage is Stage.WAITING and metrics.round == 1
    )
    assert (metrics.epoch, metrics.epochs_total, metrics.policy_version) == (6, 10, 2)
    assert (metrics.corrections, metrics.corrections_total, metrics.done) == (0, 3, False)
    eventually(
        lambda: [p.epoch for p in setup.policies] == [5, 6], "the policies of the first round"
    )
    assert setup.ask() == [], "it knows of no failure"

    first, second = setup.fail_in_practice(2**30), setup.fail_in_practice(2**30 + 1)
    task = make_task(TaskConfig())
    assert first == Correction("experiment1", 2**30, task.sample(2**30))
    setup.send(setup.correction(first))
    setup.send(setup.correction(first, id="the-same-once-more"))
    setup.send(setup.correction(first, id="of-another-policy", policy_version=1))
    foreign = setup.correction(second, id="of-another-training", training="before")
    assert "a policy of another training" in setup.send(foreign)
    setup.wait_for_metrics(lambda metrics: metrics.corrections == 1)

    # what was asked for and shown before is not forgotten
    setup.process.kill()
    setup.process.wait()
    setup.policies.clear()
    setup.start(*words)
    metrics = setup.wait_for_metrics(lambda metrics: metrics.stage is Stage.WAITING)
    assert (metrics.corrections, metrics.sequences) == (1, 4)
    eventually(lambda: [p.version for p in setup.policies] == [2], "the newest policy again")
    setup.send(setup.correction(second))
    setup.send(setup.correction(setup.fail_in_practice(2**30 + 2)))

    # The last epoch is over for a moment before its policy is published.
    metrics = setup.wait_for_metrics(
        lambda metrics: metrics.stage is Stage.FINISHED and metrics.policy_version == 3
    )
    assert (metrics.epoch, metrics.sequences, metrics.done) == (10, 6, True)
    eventually(lambda: setup.policies[-1].version == 3, "a policy of the round")
    metadata = checkpoint_from_bytes(setup.policies[-1].weights, "").metadata
    assert (metadata.epoch, metadata.cases, metadata.sequences) == (10, 6, 6)
    assert setup.ask() == []
    assert stop(setup.process) == 0


def test_cases_that_cannot_be_simulated_are_given_up(
    setup: LearnerSetup, failure: Callable[..., EpisodeFailed]
) -> None:
    setup.start()
    assert setup.ask_until_given() == case(0, 0)
    assert setup.ask() == [case(20, 0)]
    for attempt in range(TRIES):
        assert setup.ask() == [case(44, 0)], "it is handed out again, without waiting for the lease"
        report = failure(f"report{attempt}", actor="actor", seed=case(44, 0).seed)
        assert setup.fail(report) == setup.fail(report) == ""
    assert setup.ask() == []
    setup.send(setup.episode(case(0, 0)))
    assert setup.wait_for_metrics(lambda metrics: metrics.sequences == 1).stage is Stage.WAITING
    setup.send(setup.episode(case(20, 0)))
    metrics = setup.wait_for_metrics(lambda metrics: metrics.stage is not Stage.WAITING)
    assert (metrics.given_up, metrics.sequences) == (1, 2)


def test_corrections_of_an_earlier_training_do_not_count(setup: LearnerSetup) -> None:
    corrections = {"rounds": 1, "sequences": 1, "tries": 5, "epochs": 1000000}
    words = [f"--set=learner.corrections.{name}={value}" for name, value in corrections.items()]
    words += ["--set", "learner.epochs=5"]
    setup.start(*words)
    setup.show_all()
    setup.wait_for_metrics(lambda metrics: metrics.stage is Stage.WAITING and metrics.round == 1)
    eventually(lambda: bool(setup.policies), "the policy")
    setup.send(setup.correction(setup.fail_in_practice(2**30)))
    setup.wait_for_metrics(lambda metrics: metrics.stage is Stage.COUPLED and metrics.round == 1)
    setup.process.kill()
    setup.process.wait()
    shutil.rmtree(setup.folder / "checkpoints")
    setup.policies.clear()
    setup.start(*words)
    metrics = setup.wait_for_metrics(
        lambda metrics: metrics.stage is Stage.WAITING and metrics.round == 1
    )
    assert (metrics.policy_version, metrics.corrections, metrics.sequences) == (1, 0, 4)


def test_it_obeys_commands_and_a_clean_stop_loses_no_epoch(setup: LearnerSetup) -> None:
    setup.start("--set", "learner.epochs=1000000", "--set", "learner.publish_every_epochs=1000")
    setup.show_all()
    setup.wait_for_metrics(lambda metrics: metrics.stage is Stage.COUPLED and metrics.epoch > 0)

    def send_command(command: Command) -> str:
        control = setup.actor.keys.control(Role.LEARNER)
        replies = setup.actor.ask(control, Control(command), ControlReply, timeout_s=20.0)
        return " ".join(reply.note for reply in replies)

    assert send_command(Command.PAUSE) == "paused"
    paused = setup.wait_for_metrics(lambda metrics: metrics.paused and metrics.epochs_per_s == 0)
    assert (
        setup.wait_for_metrics(lambda metrics: metrics.time_s > paused.time_s).epoch == paused.epoch
    )
    checkpoint = setup.folder / "checkpoints" / "training.safetensors"
    assert send_command(Command.CHECKPOINT) == f"saved coupled epoch {paused.epoch} to {checkpoint}"
    send_command(Command.RESUME)
    setup.wait_for_metrics(lambda metrics: metrics.epoch > paused.epoch)
    assert stop(setup.process) == 0
    last = setup.metrics
    assert last is not None
    assert load_checkpoint(checkpoint).metadata.epoch >= last.epoch


def test_a_finished_policy_is_not_overwritten_by_another_network(
    setup: LearnerSetup,
) -> None:
    setup.start("--set", "learner.epochs=8")
    setup.show_all()
    # The last epoch is over for a moment before its policy is published.
    metrics = setup.wait_for_metrics(
        lambda metrics: metrics.stage is Stage.FINISHED and metrics.policy_version == 2
    )
    eventually(lambda: [p.epoch for p in setup.policies] == [5, 8], "two policies")
    assert (metrics.epoch, metrics.epochs_total) == (8, 8)
    assert not metrics.done, "the configuration asks for three versions"
    assert stop(setup.process) == 0
    written = list(setup.folder.rglob("*"))
    assert {"policies", "tutoring", "training.safetensors"} <= {path.name for path in written}
    public = [path for path in written if path.stat().st_mode & 0o077]
    assert not public, "what a run writes is for its user alone"

    checkpoint = setup.folder / "checkpoints" / "training.safetensors"
    before = checkpoint.read_bytes()
    ended = run_vmdnn("learner", *setup.words, "--set", "network.pfc.units=7")
    assert ended.returncode == 2
    assert "network.pfc" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert checkpoint.read_bytes() == before


def test_a_wrong_case_is_refused_at_the_start(setup: LearnerSetup) -> None:
    ended = run_vmdnn("learner", *setup.words, "--set", "learner.cases=[45]")
    assert ended.returncode == 2
    assert "learner.cases: there is no case 45" in ended.stderr


def test_damaged_checkpoint_policy_and_run_id_lose_no_version(setup: LearnerSetup) -> None:
    setup.start(*LONG)
    setup.show_all()
    eventually(lambda: len(setup.policies) >= 3, "three policies")
    setup.process.kill()
    setup.process.wait()
    policies = setup.folder / "policies"
    published = {path: path.read_bytes() for path in policies.glob("*.safetensors")}
    newest = max(published)
    run_id = setup.policies[-1].run_id
    weights = bytearray(published.pop(newest))
    weights[-1000] ^= 1
    newest.write_bytes(weights)
    training = training_file(setup.folder)
    training.write_bytes(b"damaged")
    training.with_name("run_id").write_bytes(b"")
    half = training.with_name("training.safetensors.0123abcd.part")
    half.touch()

    setup.policies.clear()
    setup.start(*LONG)
    eventually(lambda: len(setup.policies) >= 2, "policies after the restart")
    first, second = (policy.version for policy in setup.policies[:2])
    assert first < int(newest.stem) < second
    assert setup.policies[0].run_id != run_id, "the id of the training is lost"
    assert setup.wait_for_metrics(lambda metrics: metrics.damaged == 1).policy_version >= second
    assert newest.with_suffix(".damaged").read_bytes() == weights
    assert not half.exists()
    assert {path: path.read_bytes() for path in published} == published
