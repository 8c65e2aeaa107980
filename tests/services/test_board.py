"""A board keeps the newest metrics and the vanished processes; `vmdnn watch` shows them."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from ports import free_endpoint
from processes import PATIENCE_S, eventually
from run_metrics import ACTOR, LEARNER, RUN

from proto.bus import Bus, open_bus, open_hub
from proto.config import HubConfig
from proto.episode import Kind
from proto.keys import Role
from proto.messages import EYE_SIZE, OUTSIDE_SIZE, Live, Pictures
from proto.metrics import (
    MOST_EPOCHS,
    ActorMetrics,
    EpochMetrics,
    LearnerMetrics,
    Metrics,
    Stage,
)
from proto.periodic import every
from services.board import FORGET_AFTER_S, LOSSES_KEPT, ActorView, Board, LiveBoard
from services.cli import main


@pytest.fixture
def hub() -> Iterator[HubConfig]:
    config = HubConfig(endpoint=free_endpoint())
    with open_hub(config, RUN, "hub"):
        yield config


def join_as(hub: HubConfig, metrics: Metrics) -> Bus:
    bus = open_bus(hub, RUN, metrics.role, metrics.id)
    bus.announce()
    return bus


def publish(bus: Bus, metrics: Metrics) -> None:
    key = bus.keys.metrics(metrics.role, metrics.id)
    eventually(lambda: bus.watched(key), "somebody listens")
    bus.publish(key, metrics)


def test_the_newest_metrics_are_kept_and_dead_processes_vanish(hub: HubConfig) -> None:
    process = (Role.ACTOR, "a-1")
    with open_bus(hub, RUN, Role.WATCH, "w") as bus, join_as(hub, ACTOR) as actor:
        board = Board(bus)
        publish(actor, ACTOR)
        publish(actor, replace(ACTOR, episodes=18))
        eventually(
            lambda: board.view().metrics.get(process) == replace(ACTOR, episodes=18),
            "the newest metrics are known",
        )
        assert board.view().living(ActorMetrics) == [replace(ACTOR, episodes=18)]
        actor.close()
        eventually(lambda: process in board.view().vanished_s, "the actor has vanished")
        assert board.view().living(ActorMetrics) == []
        with join_as(hub, ACTOR):
            eventually(lambda: process not in board.view().vanished_s, "the actor is present again")


def test_every_epoch_is_told_once_however_often_one_looks(hub: HubConfig) -> None:
    def told(*epochs: int, training: str = "t-1") -> LearnerMetrics:
        done = (
            EpochMetrics(stage=Stage.COUPLED, epoch=epoch, loss=0.5, learning_rate=0.003)
            for epoch in epochs
        )
        return replace(LEARNER, training=training, epochs=tuple(done), epoch=epochs[-1])

    def taken(last: int) -> list[int]:
        """Epochs that are taken once the board knows the last of them."""
        eventually(
            lambda: [m.epoch for m in board.view().living(LearnerMetrics)] == [last],
            f"epoch {last} is known",
        )
        return [each.epoch for each in board.take_epochs()]

    with open_bus(hub, RUN, Role.WATCH, "w") as bus, join_as(hub, LEARNER) as learner:
        board = Board(bus)
        eventually(lambda: board.view().metrics or publish(learner, LEARNER), "it is present")
        for metrics in (told(1, 2), told(3), told(4, 5)):
            publish(learner, metrics)
        assert taken(5) == [1, 2, 3, 4, 5]
        assert board.take_epochs() == ()
        publish(learner, told(*range(6, 6 + MOST_EPOCHS)))
        publish(learner, told(70))
        assert taken(70) == list(range(7, 71)), "the newest ones"
        publish(learner, told(71))
        publish(learner, told(1, training="t-2"))
        assert taken(1) == [1], "those of another training are forgotten"


def test_an_actor_that_is_gone_for_good_is_forgotten(hub: HubConfig) -> None:
    now_s = 1000.0
    actor, learner = (Role.ACTOR, "a-1"), (Role.LEARNER, "l")
    with (
        open_bus(hub, RUN, Role.WATCH, "w") as bus,
        join_as(hub, ACTOR) as mortal,
        join_as(hub, LEARNER) as needed,
    ):
        board = Board(bus, clock=lambda: now_s)
        publish(mortal, ACTOR)
        publish(needed, LEARNER)
        eventually(lambda: len(board.view().metrics) == 2, "both are known")
        mortal.close()
        needed.close()
        eventually(lambda: len(board.view().vanished_s) == 2, "both have vanished")
        now_s += FORGET_AFTER_S - 1.0
        since_s = time.time() - board.view().vanished_s[actor]
        assert abs(since_s - FORGET_AFTER_S) < 30.0
        now_s += 1.0
        view = board.view()
        assert set(view.vanished_s) == set(view.metrics) == {learner}, "a run needs its learner"


def test_other_runs_are_not_seen(hub: HubConfig) -> None:
    with (
        open_bus(hub, "other", Role.WATCH, "w") as bus,
        open_bus(hub, RUN, Role.WATCH, "w") as watcher,
        join_as(hub, ACTOR) as actor,
    ):
        own, other = Board(watcher), Board(bus)
        publish(actor, ACTOR)
        assert own.wait_for_all(PATIENCE_S).metrics
        assert not other.view().metrics


def test_once_prints_the_metrics_of_every_process(
    hub: HubConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["watch", "--connect", hub.endpoint, "--set", f"run.name={RUN}", "--once", "--json"]
    with (
        join_as(hub, ACTOR) as actor,
        join_as(hub, LEARNER) as learner,
        every(0.1, lambda: publish(actor, ACTOR)),
        every(0.1, lambda: publish(learner, LEARNER)),
    ):
        assert main(arguments) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["run"] == RUN
    assert [(p["role"], p["id"]) for p in answer["processes"]] == [
        ("actor", "a-1"),
        ("learner", "l"),
    ]
    assert answer["processes"][0]["steps_per_s"] == 81.25
    assert answer["vanished"] == []


def test_a_run_without_processes_is_reported(
    hub: HubConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["watch", "--connect", hub.endpoint, "--once", "--set", "run.name=nobody"]) == 1
    assert "nobody" in capsys.readouterr().err


def test_a_hub_that_cannot_be_reached_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    endpoint = free_endpoint()
    assert main(["watch", "--connect", endpoint, "--once"]) == 2
    assert endpoint in capsys.readouterr().err


def test_losses_are_kept_and_thinned_out(hub: HubConfig) -> None:
    with open_bus(hub, RUN, Role.WATCH, "w") as bus, join_as(hub, LEARNER) as learner:
        board = Board(bus)
        publish(learner, replace(LEARNER, epoch=0))
        eventually(lambda: bool(board.view().metrics), "the learner is present")
        for epoch in range(1, 4 * LOSSES_KEPT):
            publish(learner, replace(LEARNER, epoch=epoch, loss=1.0 / epoch))
        publish(learner, replace(LEARNER, stage=Stage.FINISHED))
        eventually(lambda: len(board.losses) > LOSSES_KEPT // 3, "losses are known")
        epochs = [loss.epoch for loss in board.losses]
        assert len(epochs) <= LOSSES_KEPT
        assert epochs == sorted(epochs)
        assert {loss.stage for loss in board.losses} == {Stage.COUPLED}


def step(number: int, focus: float = 3.0) -> Live:
    return Live(
        actor="a-1",
        kind=Kind.TRIAL,
        policy="p",
        policy_version=3,
        step=number,
        phase="lift",
        image=np.full((48, 64), number, np.uint8),
        joints_deg=np.zeros(18, np.float32),
        action=np.array([0.0] * 10 + [focus], np.float32),
        body_poses=np.zeros((1, 7), np.float32),
        focal_px=np.array([50.0, 60.0], np.float32),
    )


def test_only_actors_that_are_watched_are_listened_to(hub: HubConfig) -> None:
    with open_bus(hub, RUN, Role.WATCH, "w") as bus, join_as(hub, ACTOR) as actor:
        board, key = LiveBoard(bus, start_focus=1.0), actor.keys.live("a-1")
        assert not actor.watched(key)
        board.watch({"a-1"})
        eventually(lambda: actor.watched(key), "it is watched")

        def heard(number: int, focus: float = 3.0) -> ActorView:
            actor.publish(key, step(number, focus))
            eventually(
                lambda: "a-1" in board.actors() and board.actors()["a-1"].live.step == number,
                "the step is heard",
            )
            return board.actors()["a-1"]

        assert heard(0, focus=7.0).focus == 1.0, "every episode starts so"
        view = heard(1)
        assert view.focus == 7.0, "the focus that the step before commanded"
        assert [live.step for live in view.path] == [0, 1]
        assert heard(0).episode == view.episode + 1
        assert [live.step for live in board.actors()["a-1"].path] == [0]
        board.watch(set())
        eventually(lambda: not actor.watched(key), "it is not watched any more")
        assert not board.actors()


def test_pictures_are_asked_for_only_while_somebody_looks(hub: HubConfig) -> None:
    with open_bus(hub, RUN, Role.WATCH, "w") as bus, join_as(hub, ACTOR) as actor:
        board, key = LiveBoard(bus, start_focus=1.0), actor.keys.pictures("a-1")
        board.watch({"a-1"})
        assert not actor.watched(key)
        board.watch({"a-1"}, {"a-1"})
        eventually(lambda: actor.watched(key), "pictures are wanted")
        outside = np.full(OUTSIDE_SIZE, 7, np.uint8)
        actor.publish(key, Pictures("a-1", 4, outside, np.zeros(EYE_SIZE, np.uint8)))
        eventually(lambda: board.pictures("a-1") is not None, "pictures have come")
        told = board.pictures("a-1")
        assert told is not None
        assert np.array_equal(told.outside, outside)
        board.watch({"a-1"})
        assert board.pictures("a-1") is None
        eventually(lambda: not actor.watched(key), "nobody looks any more")
