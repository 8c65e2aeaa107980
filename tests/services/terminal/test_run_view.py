"""The state of a run as tables and as one line."""

from __future__ import annotations

import io
import time
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console
from run_metrics import ACTOR, EVALUATOR, LEARNER, RECORDER, RUN, score, view_of

from proto.keys import Role
from proto.metrics import Stage, SuiteScore
from services.board import RunView
from services.terminal.run_progress import Progress
from services.terminal.run_tables import fitting_tables, run_tables
from services.terminal.run_words import duration_words, run_line

STARTED = {Role.LEARNER: 1, Role.EVALUATOR: 1, Role.RECORDER: 1, Role.ACTOR: 2}


def shown(view: RunView, **settings: Any) -> str:
    console = Console(file=io.StringIO(), width=160)
    console.print(run_tables(view, **settings))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def fitted(view: RunView, width: int, height: int) -> list[str]:
    """What a terminal of this size shows, line by line."""
    console = Console(file=io.StringIO(), width=width, height=height, force_terminal=True)
    lines = console.render_lines(fitting_tables(view, console, Progress(72.0, 190.0), STARTED))
    return ["".join(segment.text for segment in line).rstrip() for line in lines]


def test_tables_show_the_metrics_of_each_process() -> None:
    text = shown(view_of(ACTOR, LEARNER, EVALUATOR, RECORDER))
    for expected in (
        *("a-1", "81.2", "trial: moved object", "epoch 120 of 2500", "0.4321", "12.5 epochs/s"),
        *("policy 3 of 13", "52 of 52 trials of policy 3", "12 episodes, 3.4 MB"),
    ):
        assert expected in text
    assert "52/52" in text
    assert "85 % (72 to 92)" in text
    assert "policy 3, not precise: moved object 4, imprecise 2" in text
    assert text.index("85 % (72") < text.index("30 % ("), "the newest policy comes first"


def test_tables_show_vanished_processes_and_a_part_of_many_actors() -> None:
    many = view_of(*(replace(ACTOR, id=f"a-{number:02}") for number in range(40)))
    gone = replace(many, vanished_s={(Role.ACTOR, "a-07"): time.time()})
    text = shown(gone)
    assert "actor a-07 is gone" in text
    assert "and 27 more" in text
    assert "39 actors" in text


def test_one_line_summarizes_the_run() -> None:
    assert run_line(view_of(ACTOR, LEARNER, EVALUATOR), Progress(72.0, 190.0, at_least=True)) == (
        "policy 3 of 13, 1 min 12 s so far, more than 3 min left"
        " | learner: coupled training, epoch 120 of 2500, loss 0.4321, 12.5 epochs/s, 45 sequences"
        " | evaluator: 52 of 52 trials of policy 3, 1 of earlier ones being played"
        " | 1 actor, 81 steps/s, 17 episodes | policy 3 strict 44 of 52, 85 % (72 to 92)"
    )


def test_several_suites_are_shown_beside_each_other() -> None:
    beyond = SuiteScore("beyond", "sapien", 40, "", (score(2, 1, 10), score(3, 30, 40)))
    elsewhere = SuiteScore("elsewhere", "other", 40, "no actor has other", ())
    several = replace(EVALUATOR, suites=(*EVALUATOR.suites, beyond, elsewhere))
    text = shown(view_of(several))
    for expected in ("unlearned", "52/52", "40/40", "75 %", "0/40"):
        assert expected in text
    assert "suite elsewhere is not played: no actor has other" in text
    line = run_line(view_of(several))
    assert "| policy 3 strict 44 of 52, 85 % (72 to 92) | beyond strict 30 of 40, 75 %" in line
    assert line.endswith("| elsewhere is not played: no actor has other")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"stage": Stage.WAITING, "sequences": 13},
            "waiting for sequences: 13 of 45 sequences",
        ),
        (
            {
                **{"stage": Stage.WAITING, "round": 2, "rounds": 4},
                **{"corrections": 12, "corrections_total": 45},
            },
            "waiting for corrections of round 2 of 4: 12 of 45",
        ),
        ({"round": 2, "rounds": 4}, "coupled training, round 2 of 4, epoch 120 of 2500"),
        ({"stage": Stage.FINISHED, "round": 2}, "finished"),
        ({"paused": True}, "paused, coupled training"),
    ],
)
def test_the_stage_of_the_learner_is_shown(given: dict[str, Any], said: str) -> None:
    view = view_of(replace(LEARNER, **given))
    assert f"learner: {said}" in run_line(view)
    assert said in shown(view)


def test_an_empty_view_can_be_shown() -> None:
    assert run_line(view_of()) == "no process of this run is there | no actor"
    assert RUN in shown(view_of())


def test_there_is_something_to_read_while_the_processes_start() -> None:
    nothing = view_of()
    for text in (run_line(nothing, expected=STARTED), shown(nothing, expected=STARTED)):
        assert "starting learner, evaluator, recorder and 2 actors (an actor takes" in text
    one = view_of(LEARNER, EVALUATOR, RECORDER, ACTOR)
    assert "starting 1 actor (an actor takes" in run_line(one, expected=STARTED)
    both = view_of(LEARNER, EVALUATOR, RECORDER, ACTOR, replace(ACTOR, id="a-2"))
    assert "starting" not in run_line(both, expected=STARTED)


def test_without_a_policy_actors_wait_for_the_first_one() -> None:
    waiting = replace(
        ACTOR, policy_version=0, steps_per_s=0.0, waiting_for="the first policy", last_kind=None
    )
    view = view_of(waiting, replace(LEARNER, policy_version=0), replace(EVALUATOR, suites=()))
    for text in (run_line(view), shown(view)):
        assert "1 actor, waiting for the first policy" in text
        assert "0.0" not in text
    assert "evaluator  waiting for the first policy" in shown(view)


def test_a_precise_outcome_is_called_success() -> None:
    assert "trial: success" in shown(view_of(replace(ACTOR, last_outcome="none")))


def test_problems_are_shown() -> None:
    view = view_of(replace(ACTOR, put_aside=3), replace(LEARNER, given_up=2))
    assert "actor a-1: 3 messages put aside" in shown(view)
    assert "2 given up" in run_line(view)
    assert "put aside" not in shown(view_of(ACTOR))


def test_what_processes_wait_for_is_shown() -> None:
    waiting = replace(EVALUATOR, waiting_for="the hub")
    view = view_of(replace(ACTOR, waiting_for="the [hub]"), LEARNER, waiting)
    assert "waiting for the [hub]" in shown(view)
    for text in (shown(view), run_line(view)):
        assert "evaluator e waits for the hub" in text
    usual = replace(EVALUATOR, waiting_for="3 trials of policy 3")
    assert "waits" not in shown(view_of(LEARNER, usual))


def full_view() -> RunView:
    """A run with many actors, versions and suites, and long names."""
    actors = [
        replace(ACTOR, id=f"a-machine-with-a-long-name-{n}", last_outcome="touched_the_obstacle")
        for n in range(30)
    ]
    scores = tuple(score(version, version, 52) for version in range(1, 40))
    suites = tuple(SuiteScore(f"suite-{n}", "sapien", 52, "", scores[-1:]) for n in range(9))
    evaluator = replace(EVALUATOR, suites=(replace(EVALUATOR.suites[0], policies=scores), *suites))
    return view_of(*actors, LEARNER, evaluator, RECORDER)


@pytest.mark.parametrize("size", [(80, 24), (200, 50), (80, 12)])
def test_the_tables_fit_into_the_terminal_and_cut_no_word(size: tuple[int, int]) -> None:
    for view in (full_view(), view_of(LEARNER, ACTOR, EVALUATOR, RECORDER), view_of()):
        lines = fitted(view, *size)
        assert len(lines) < size[1]
        assert max(map(len, lines)) <= size[0]
        whole = " ".join(fitted(view, 1000, size[1])).split()
        cut = set(" ".join(lines).split()) - set(whole)
        assert [word for word in cut if not word.isdigit()] == [], "counts of what is left out"
        assert "policy 3 of 13, 1 min 12 s so far, about 3 min left" in " ".join(lines) or (
            not view.metrics
        )


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (59.4, "59 s"), (59.6, "1 min 0 s"), (192, "3 min 12 s"), (7500, "2 h 5 min")],
)
def test_durations_in_words(seconds: float, words: str) -> None:
    assert duration_words(seconds) == words


def test_certificates_that_expire_are_told() -> None:
    view = view_of(replace(ACTOR, certificate_days=12), LEARNER)
    said = "the certificate of actor a-1 expires in 12 days: deploy/certificates.sh --renew"
    assert said in shown(view)
    assert said in run_line(view)
    both = view_of(replace(ACTOR, certificate_days=12), replace(LEARNER, certificate_days=1))
    assert "the certificates of learner l and 1 more expire tomorrow" in shown(both)
    assert "certificate" not in shown(view_of(ACTOR, LEARNER))
