"""The state of a run as tables and as one line."""

from __future__ import annotations

import io
import time
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console
from run_metrics import ACTOR, EVALUATOR, LEARNER, RUN, score, view_of

from proto.keys import Role
from proto.metrics import Stage, SuiteScore
from services.board import RunView
from services.terminal.run_tables import run_tables
from services.terminal.run_words import run_line


def shown(view: RunView) -> str:
    console = Console(file=io.StringIO(), width=160)
    console.print(run_tables(view))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_tables_show_the_metrics_of_each_process() -> None:
    text = shown(view_of(ACTOR, LEARNER, EVALUATOR))
    for expected in ("a-1", "81.2", "trial: moved_object", "120/2500", "0.4321", "12.5"):
        assert expected in text
    assert "44 of 52, 85 % (72 to 92)" in text
    assert "moved_object 4, imprecise 2" in text
    assert text.index("44 of 52") < text.index("3 of 10"), "the newest policy comes first"


def test_tables_show_vanished_processes_and_a_part_of_many_actors() -> None:
    many = view_of(*(replace(ACTOR, id=f"a-{number:02}") for number in range(40)))
    gone = replace(many, vanished_s={(Role.ACTOR, "a-07"): time.time()})
    text = shown(gone)
    assert "actor a-07 is gone" in text
    assert "27 more" in text
    assert "39 actors" in text


def test_one_line_summarizes_the_run() -> None:
    assert run_line(view_of(ACTOR, LEARNER, EVALUATOR)) == (
        "learner coupled, epoch 120/2500, loss 0.4321, 45 sequences, 12.5 epochs/s, policy 3"
        " | 1 actor, 81 steps/s, 17 episodes | policy 3 strict 44 of 52, 85 % (72 to 92)"
    )


def test_several_suites_are_shown_beside_each_other() -> None:
    beyond = SuiteScore("beyond", "sapien", 40, "", (score(2, 1, 10), score(3, 30, 40)))
    elsewhere = SuiteScore("elsewhere", "other", 40, "no actor has other", ())
    several = replace(EVALUATOR, suites=(*EVALUATOR.suites, beyond, elsewhere))
    text = shown(view_of(several))
    for expected in ("unlearned", "52/52", "40/40", "30 of 40, 75 %", "0/40"):
        assert expected in text
    assert "suite elsewhere is not played: no actor has other" in text
    line = run_line(view_of(several))
    assert "| policy 3 strict 44 of 52, 85 % (72 to 92) | beyond strict 30 of 40, 75 %" in line
    assert line.endswith("| elsewhere is not played: no actor has other")


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
def test_the_stage_of_the_learner_is_shown(given: dict[str, Any], said: str) -> None:
    view = view_of(replace(LEARNER, **given))
    assert run_line(view).startswith(f"learner {said}, epoch")
    assert f" {said} " in shown(view)


def test_an_empty_view_can_be_shown() -> None:
    assert run_line(view_of()) == "0 actors, 0 steps/s, 0 episodes"
    assert RUN in shown(view_of())


def test_problems_are_shown() -> None:
    view = view_of(replace(ACTOR, put_aside=3), replace(LEARNER, given_up=2))
    assert "2, 3 put aside" in shown(view)
    assert "2 given up" in run_line(view)
    assert "put aside" not in shown(view_of(ACTOR))


def test_what_processes_wait_for_is_shown() -> None:
    view = view_of(replace(ACTOR, waiting_for="the [hub]"), LEARNER)
    assert "actor a-1 waits for the [hub]" in shown(view)
    assert "learner l waits" not in shown(view)
