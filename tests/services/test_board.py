"""A board keeps the newest metrics and the vanished processes; `vmdnn watch` shows them."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest
from ports import free_endpoint
from processes import PATIENCE_S, eventually
from run_metrics import ACTOR, LEARNER, RUN

from proto.bus import Bus, open_bus, open_hub
from proto.config import HubConfig
from proto.keys import Role
from proto.metrics import ActorMetrics, Metrics
from proto.periodic import every
from services.board import FORGET_AFTER_S, Board
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
