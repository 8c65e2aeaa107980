"""Whoever watches sees every process's newest metrics, who vanished, and what succeeded."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from proto.bus import Bus, open_bus, open_hub
from proto.config import HubConfig
from proto.episode import Kind
from proto.keys import Role
from proto.membership import every
from proto.metrics import (
    ActorMetrics,
    EvaluatorMetrics,
    LearnerMetrics,
    Metrics,
    PolicyScore,
    Stage,
    Success,
)
from services.board import Board, View, summary_line, tables
from services.cli import main
from services.trials.success import wilson95
from tests.ports import free_endpoint

RUN = "watched"
ACTOR = ActorMetrics(
    id="a-1", time_s=1.0, refused=0, policy_version=3, steps_per_s=81.25, episodes=17,
    last_outcome="moved_object", last_kind=Kind.TRIAL, backend="sapien", outbox=2,
    paused=False,
)  # fmt: skip
LEARNER = LearnerMetrics(
    id="l", time_s=1.0, refused=0, stage=Stage.COUPLED, epoch=120, epochs_total=2500, loss=0.4321,
    sequences=45, round=0, corrections=0, corrections_total=0, epochs_per_s=12.5, policy_version=3,
    paused=False, done=False,
)  # fmt: skip


def success(successes: int, trials: int) -> Success:
    return Success(successes, successes / trials, wilson95(successes, trials))


def score(version: int, strict: int, trials: int) -> PolicyScore:
    rate = success(strict, trials)
    reasons = {"imprecise": 2, "moved_object": 4}
    return PolicyScore(version, trials, success(trials, trials), rate, rate, reasons)


EVALUATOR = EvaluatorMetrics(
    id="e", time_s=1.0, refused=0, policies=(score(2, 3, 10), score(3, 44, 52)), leases=1,
    paused=False, done=False,
)  # fmt: skip


@pytest.fixture
def hub() -> Iterator[HubConfig]:
    config = HubConfig(endpoint=free_endpoint())
    with open_hub(config, RUN, "hub"):
        yield config


def soon(condition: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + 10
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)
    return condition()


def present(hub: HubConfig, metrics: Metrics) -> Bus:
    bus = open_bus(hub, RUN, metrics.role, metrics.id)
    bus.announce()
    return bus


def tell(bus: Bus, metrics: Metrics) -> None:
    bus.publish(bus.keys.metrics(metrics.role, metrics.id), metrics)


def view_of(*metrics: Metrics) -> View:
    return View(RUN, {(m.role, m.id): m for m in metrics}, {})


def shown(view: View) -> str:
    console = Console(file=io.StringIO(), width=160)
    console.print(tables(view))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_the_newest_metrics_are_kept_and_who_dies_vanishes(hub: HubConfig) -> None:
    process = (Role.ACTOR, "a-1")
    with open_bus(hub, RUN, Role.WATCH, "w") as bus, present(hub, ACTOR) as actor:
        board = Board(bus)
        tell(actor, ACTOR)
        tell(actor, replace(ACTOR, episodes=18))
        assert soon(lambda: board.view().metrics.get(process) == replace(ACTOR, episodes=18))
        assert board.view().living(ActorMetrics) == [replace(ACTOR, episodes=18)]
        actor.close()
        assert soon(lambda: process in board.view().vanished_s)
        assert board.view().living(ActorMetrics) == []
        with present(hub, ACTOR):
            assert soon(lambda: process not in board.view().vanished_s)


def test_other_runs_are_not_seen(hub: HubConfig) -> None:
    with open_bus(hub, "other", Role.WATCH, "w") as bus, present(hub, ACTOR) as actor:
        board = Board(bus)
        tell(actor, ACTOR)
        assert not board.wait_until_all_told(0.5).metrics


def test_once_prints_every_process_as_it_told(
    hub: HubConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["watch", "--connect", hub.endpoint, "--set", f"run.name={RUN}", "--once", "--json"]
    with (
        present(hub, ACTOR) as actor,
        present(hub, LEARNER) as learner,
        every(0.1, lambda: tell(actor, ACTOR)),
        every(0.1, lambda: tell(learner, LEARNER)),
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


def test_a_run_of_which_nobody_tells_is_named(
    hub: HubConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["watch", "--connect", hub.endpoint, "--once", "--set", "run.name=nobody"]) == 1
    assert "nobody" in capsys.readouterr().err


def test_a_hub_that_cannot_be_reached_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    endpoint = free_endpoint()
    assert main(["watch", "--connect", endpoint, "--once"]) == 2
    assert endpoint in capsys.readouterr().err


def test_tables_show_what_each_process_told() -> None:
    text = shown(view_of(ACTOR, LEARNER, EVALUATOR))
    for expected in ("a-1", "81.2", "trial: moved_object", "120/2500", "0.4321", "12.5"):
        assert expected in text
    assert "44 of 52, 85 % (72 to 92)" in text
    assert "moved_object 4, imprecise 2" in text
    assert text.index("44 of 52") < text.index("3 of 10"), "the newest policy comes first"


def test_tables_show_who_vanished_and_of_many_actors_only_some() -> None:
    many = view_of(*(replace(ACTOR, id=f"a-{number:02}") for number in range(40)))
    gone = replace(many, vanished_s={(Role.ACTOR, "a-07"): time.time()})
    text = shown(gone)
    assert "actor a-07 is gone" in text
    assert "27 more" in text
    assert "39 actors" in text


def test_a_line_says_it_all_briefly() -> None:
    assert summary_line(view_of(ACTOR, LEARNER, EVALUATOR)) == (
        "learner coupled, epoch 120/2500, loss 0.4321, 45 sequences, 12.5 epochs/s, policy 3"
        " | 1 actor, 81 steps/s, 17 episodes | policy 3 strict 44 of 52, 85 % (72 to 92)"
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"stage": Stage.WAITING}, "waiting for sequences"),
        (
            {"stage": Stage.WAITING, "round": 2, "corrections": 12, "corrections_total": 45},
            "waiting for corrections 12/45",
        ),
        ({"round": 2}, "coupled, round 2"),
        ({"stage": Stage.FINISHED, "round": 2}, "finished"),
    ],
)
def test_what_the_learner_is_at(given: dict[str, Any], said: str) -> None:
    view = view_of(replace(LEARNER, **given))
    assert summary_line(view).startswith(f"learner {said}, epoch")
    assert f" {said} " in shown(view)


def test_a_view_of_nothing_can_be_shown() -> None:
    assert summary_line(view_of()) == "0 actors, 0 steps/s, 0 episodes"
    assert RUN in shown(view_of())
