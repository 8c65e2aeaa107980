"""The estimate of what is left of a run."""

from __future__ import annotations

from dataclasses import replace

import pytest
from run_metrics import ACTOR, EVALUATOR, LEARNER, score, view_of

from proto.metrics import LearnerMetrics, Stage, SuiteScore
from services.terminal.run_progress import Progress, ProgressMeter


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_what_is_left_follows_from_the_speed_of_each_kind_of_work() -> None:
    clock = Clock()
    meter = ProgressMeter(started_s=90.0, clock=clock)
    waiting = replace(
        LEARNER, stage=Stage.WAITING, epoch=0, epochs_total=20, epochs_later=60, loss=None,
        sequences=0, sequences_total=6, policy_version=0, rounds=1,
    )  # fmt: skip
    evaluator = replace(EVALUATOR, suites=(SuiteScore("unlearned", "sapien", 10, "", ()),))
    actor = replace(ACTOR, policy_version=0, episodes=0)

    def look(learner: LearnerMetrics, episodes: int, passed_s: float) -> Progress:
        clock.now_s += passed_s
        return meter.look(view_of(learner, evaluator, replace(actor, episodes=episodes)))

    assert look(waiting, 0, 0.0) == Progress(10.0, None, at_least=True)
    progress = look(replace(waiting, sequences=2), 2, 4.0)
    assert progress == Progress(14.0, 8.0, at_least=True), "the speed of all else is not known"

    pretraining = replace(waiting, stage=Stage.PRETRAINING, sequences=6)
    look(pretraining, 6, 8.0)
    progress = look(replace(pretraining, epoch=10), 6, 5.0)
    assert progress.left_s == pytest.approx(10 * 0.5)
    coupled = replace(
        pretraining, stage=Stage.COUPLED, epoch=0, epochs_total=60, epochs_later=0,
        policy_version=1,
    )  # fmt: skip
    look(replace(pretraining, epoch=20), 6, 5.0)
    look(coupled, 6, 0.0)
    progress = look(replace(coupled, epoch=10), 11, 10.0)
    # 50 epochs of 1 s, 10 trials of 2 s; the round of corrections is not known yet
    assert progress.left_s == pytest.approx(50 + 10 * 2)
    assert progress.at_least

    correcting = replace(coupled, stage=Stage.WAITING, epoch=40, round=1, corrections_total=5)
    look(replace(coupled, epoch=40), 26, 30.0)
    look(correcting, 26, 0.0)
    look(replace(coupled, epoch=40, round=1), 36, 20.0)
    progress = look(replace(coupled, epoch=50, round=1), 41, 10.0)
    assert progress.left_s == pytest.approx(10 * 1 + 10 * 2)
    assert not progress.at_least

    finished = replace(coupled, stage=Stage.FINISHED, epoch=60, round=1, policy_version=2)
    counted = replace(
        evaluator, suites=(replace(evaluator.suites[0], policies=(score(2, 0, 10),)),)
    )
    clock.now_s += 20.0
    done = meter.look(view_of(finished, counted, actor))
    assert done.left_s is None, "nothing is left"
    assert not done.at_least


def test_without_a_learner_nothing_is_estimated() -> None:
    clock = Clock()
    assert ProgressMeter(clock=clock).look(view_of()) == Progress()
    running = replace(ACTOR, running_s=65.0)
    assert ProgressMeter(clock=clock).look(view_of(running)) == Progress(65.0)


def test_a_viewer_takes_the_time_of_the_process_that_has_run_for_the_longest_time() -> None:
    learner, restarted = replace(LEARNER, running_s=4000.0), replace(ACTOR, running_s=3.0)
    assert ProgressMeter().look(view_of(learner, restarted)).elapsed_s == 4000.0
    assert ProgressMeter().look(view_of(restarted)).elapsed_s == 3.0
