"""The evaluator as a process: hands out, counts once, carries on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from subprocess import Popen

import pytest
from outcomes import NOT_LIFTED, PRECISE
from ports import free_endpoint
from processes import eventually, listening_hub, run_vmdnn, stop, vmdnn

from proto.bus import Bus, open_bus
from proto.config import HubConfig
from proto.episode import Episode, Kind
from proto.keys import Role
from proto.messages import (
    Command,
    Control,
    ControlReply,
    PolicyVersion,
    Receipt,
    Rollout,
    Trial,
    TrialRequest,
    Verdict,
)
from proto.metrics import EvaluatorMetrics

MakeEpisode = Callable[..., Episode]


class Field:
    """A hub, an evaluator, and sessions that act as learner and actors."""

    def __init__(self, stack: ExitStack, folder: Path, make_episode: MakeEpisode) -> None:
        self._stack = stack
        self._make_episode = make_episode
        self.endpoint = free_endpoint()
        self.words = (
            *("--connect", self.endpoint, "--set", f"run.folder={folder}"),
            *("--set", "run.name=test", "--set", "evaluator.trials_per_policy=3"),
            *("--set", "evaluator.seed=70", "--set", "evaluator.lease_s=1000"),
            *("--set", "done.trials=3"),
            *("--set", "done.policy_versions=2"),
        )
        stack.enter_context(listening_hub(self.endpoint))
        self.told: EvaluatorMetrics | None = None
        self.learner = self.join(Role.LEARNER, "learner")
        self.learner.subscribe(
            self.learner.keys.metrics(Role.EVALUATOR), self._listen, EvaluatorMetrics
        )
        self.verdicts: list[Verdict] = []
        self.learner.subscribe(self.learner.keys.verdict, self.verdicts.append, Verdict)
        self.process = self.start()

    def start(self) -> Popen[bytes]:
        self.told = None
        self.process = self._stack.enter_context(vmdnn("evaluator", *self.words))
        return self.process

    def join(self, role: Role, name: str) -> Bus:
        bus = open_bus(HubConfig(endpoint=self.endpoint), "test", role, name)
        return self._stack.enter_context(bus)

    def publish(self, version: int, run_id: str = "training") -> None:
        policy = PolicyVersion(run_id, version, 10, 0.5, "digest", b"weights")
        self.learner.publish_newest(self.learner.keys.policy, policy)

    def ask(self, actor: Bus, version: int, run_id: str = "training") -> list[int]:
        request = TrialRequest(actor.id, run_id, version)
        return [trial.seed for trial in actor.ask(actor.keys.request_trial, request, Trial)]

    def ask_until_given(self, actor: Bus, version: int) -> int:
        seeds: list[int] = []

        def given() -> bool:
            seeds.extend(self.ask(actor, version))
            return bool(seeds)

        eventually(given, f"a trial of policy {version}")
        return seeds[0]

    def verdicts_by_seed(self) -> dict[int, Verdict]:
        return {verdict.seed: verdict for verdict in self.verdicts}

    def tells(self, what: Callable[[EvaluatorMetrics], bool]) -> EvaluatorMetrics:
        eventually(lambda: self.told is not None and what(self.told), "the metrics it should tell")
        assert self.told is not None
        return self.told

    def send(self, actor: Bus, seed: int, version: int, **fields: object) -> Episode:
        """Send a rollout until its receipt comes."""
        given = {"kind": Kind.TRIAL, "outcome": PRECISE, "id": f"{seed}-{version}", **fields}
        episode = self._make_episode(3, actor=actor.id, seed=seed, policy_version=version, **given)
        receipts: list[Receipt] = []
        actor.subscribe(actor.keys.receipt(actor.id), receipts.append, Receipt)

        def received() -> bool:
            actor.deliver(actor.keys.rollout(actor.id), Rollout(episode, "training"))
            return Receipt(episode.id) in receipts

        eventually(received, "a receipt")
        return episode

    def _listen(self, metrics: EvaluatorMetrics) -> None:
        self.told = metrics


@pytest.fixture
def field(tmp_path: Path, make_episode: MakeEpisode) -> Iterator[Field]:
    with ExitStack() as stack:
        yield Field(stack, tmp_path, make_episode)


def counts(metrics: EvaluatorMetrics) -> dict[int, int]:
    return {score.version: score.trials for score in metrics.policies}


def test_every_policy_gets_the_same_situations_each_counted_once(field: Field) -> None:
    actor, other = field.join(Role.ACTOR, "a"), field.join(Role.ACTOR, "b")
    field.publish(1)
    seeds = [field.ask_until_given(actor, 1), *field.ask(other, 1), *field.ask(actor, 1)]
    assert seeds == [70, 71, 72]
    assert field.ask(other, 1) == [], "all three are being played"
    field.tells(lambda told: told.leases == 3)

    field.send(actor, 70, 1)
    field.send(actor, 70, 1)
    field.send(other, 70, 1, id="another-episode-of-this-trial", outcome=NOT_LIFTED)
    field.send(other, 71, 1, outcome=NOT_LIFTED)
    field.send(other, 99, 1)  # nobody asked for it
    field.send(actor, 5, 1, kind=Kind.PRACTICE)
    told = field.tells(lambda told: counts(told) == {1: 2})
    score = told.policies[0]
    assert (score.precise.successes, score.precise.rate) == (1, 0.5)
    assert score.precise.wilson95 == pytest.approx((0.0945, 0.9055), abs=1e-3)
    assert score.reasons == {"not_lifted": 1}
    assert not told.done

    field.publish(2)
    assert field.ask_until_given(actor, 2) == 70
    assert field.ask(actor, 1) == [], "only the newest policy is tried"
    field.send(actor, 72, 1)  # was under way when the newer policy came
    for seed in (70, 71, 72):
        field.send(actor, seed, 2)
    told = field.tells(lambda told: counts(told) == {1: 3, 2: 3})
    assert told.done
    assert told.leases == 0
    assert field.ask(actor, 2) == [], "the newest policy is counted in full"


def test_the_learner_hears_of_practice_but_never_of_the_situations_of_trials(
    field: Field,
) -> None:
    actor = field.join(Role.ACTOR, "a")
    field.publish(1)
    field.ask_until_given(actor, 1)
    field.send(actor, 70, 1, outcome=NOT_LIFTED)
    field.send(actor, 70, 1, id="not-even-if-practised", kind=Kind.PRACTICE, outcome=NOT_LIFTED)
    field.send(actor, 99, 1, id="a-trial-that-nobody-asked-for")
    field.send(actor, 98, 1, id="another-task", kind=Kind.PRACTICE, task="reaching")
    practised = field.send(actor, 2**30, 1, kind=Kind.PRACTICE, outcome=NOT_LIFTED)
    eventually(lambda: bool(field.verdicts), "a verdict")
    assert set(field.verdicts_by_seed()) == {2**30}
    told = field.verdicts_by_seed()[2**30]
    assert (told.run_id, told.policy_version, told.task) == ("training", 1, "experiment1")
    assert (told.outcome, dict(told.situation)) == (NOT_LIFTED, dict(practised.situation))


def test_a_killed_evaluator_carries_on_with_what_it_counted(field: Field) -> None:
    actor = field.join(Role.ACTOR, "a")
    field.publish(1)
    assert field.ask_until_given(actor, 1) == 70
    field.send(actor, 70, 1)
    field.process.kill()
    field.process.wait()
    field.start()
    field.send(actor, 70, 1)  # its receipt might have been lost
    assert field.ask_until_given(actor, 1) == 71
    assert counts(field.tells(lambda told: bool(told.policies))) == {1: 1}
    assert stop(field.process) == 0


def test_a_trial_of_an_actor_that_died_is_given_to_another(field: Field) -> None:
    mortal, other = field.join(Role.ACTOR, "mortal"), field.join(Role.ACTOR, "other")
    mortal.announce()
    field.publish(1)
    assert field.ask_until_given(mortal, 1) == 70
    assert field.ask(other, 1) == [71]
    mortal.close()
    eventually(lambda: field.ask(other, 1) == [70], "the dead actor's trial")


def test_a_new_training_is_counted_anew(field: Field) -> None:
    actor = field.join(Role.ACTOR, "a")
    field.publish(5)
    assert field.ask_until_given(actor, 5) == 70
    field.send(actor, 70, 5)
    field.tells(lambda told: counts(told) == {5: 1})
    field.publish(1, run_id="started-from-nothing")
    field.tells(lambda told: counts(told) == {})
    assert field.ask(actor, 1, run_id="started-from-nothing") == [70]


def test_a_pause_stops_the_handing_out_but_not_the_counting(field: Field) -> None:
    actor = field.join(Role.ACTOR, "a")
    field.publish(1)
    field.ask_until_given(actor, 1)
    control = actor.keys.control(Role.EVALUATOR)
    assert [r.note for r in actor.ask(control, Control(Command.PAUSE), ControlReply)] == ["paused"]
    assert field.ask(actor, 1) == []
    field.send(actor, 70, 1)
    field.tells(lambda told: told.paused and counts(told) == {1: 1})
    actor.ask(control, Control(Command.RESUME), ControlReply)
    assert field.ask(actor, 1) == [71]
    actor.ask(control, Control(Command.STOP), ControlReply)
    assert field.process.wait(30) == 0


def test_a_second_evaluator_of_the_same_folder_is_refused(field: Field) -> None:
    field.tells(lambda _: True)
    second = run_vmdnn("evaluator", *field.words, "--id", "second")
    assert second.returncode == 2
    assert "already works in" in second.stderr


def test_without_a_hub_it_says_what_to_do(tmp_path: Path) -> None:
    words = ("--connect", free_endpoint(), "--set", f"run.folder={tmp_path}")
    ended = run_vmdnn("evaluator", *words)
    assert ended.returncode == 2
    assert "start one with `vmdnn hub`" in ended.stderr
    assert "Traceback" not in ended.stderr
