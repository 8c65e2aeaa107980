"""Metrics of a run's processes, for tests of the displays."""

from __future__ import annotations

from proto.episode import Kind
from proto.metrics import (
    ActorMetrics,
    EvaluatorMetrics,
    LearnerMetrics,
    Metrics,
    PolicyScore,
    RecorderMetrics,
    Stage,
    Success,
    SuiteScore,
)
from services.board import RunView
from services.trials.success import wilson95

RUN = "watched"
ACTOR = ActorMetrics(
    id="a-1", time_s=1.0, refused=0, policy_version=3, steps_per_s=81.25, episodes=17,
    last_outcome="moved_object", last_kind=Kind.TRIAL, backend="sapien", outbox=2,
    put_aside=0, failed=0, paused=False,
)  # fmt: skip
LEARNER = LearnerMetrics(
    id="l", time_s=1.0, refused=0, stage=Stage.COUPLED, epoch=120, epochs_total=2500,
    epochs_later=0, loss=0.4321, learning_rate=0.002, training="t-1", sequences=45,
    sequences_total=45, round=0, rounds=0, corrections=0, corrections_total=0, damaged=0,
    given_up=0, epochs_per_s=12.5, policy_version=3, policies_total=13, paused=False, done=False,
)  # fmt: skip


def success(successes: int, trials: int) -> Success:
    return Success(successes, successes / trials, wilson95(successes, trials))


def score(version: int, strict: int, trials: int) -> PolicyScore:
    rate = success(strict, trials)
    reasons = {"imprecise": 2, "moved_object": 4}
    return PolicyScore(version, trials, success(trials, trials), rate, rate, reasons)


SCORES = (score(2, 3, 10), score(3, 44, 52))
EVALUATOR = EvaluatorMetrics(
    id="e", time_s=1.0, refused=0, policies=SCORES, damaged=0,
    suites=(SuiteScore("unlearned", "sapien", 52, "", SCORES),), leases=1, paused=False, done=False,
)  # fmt: skip


RECORDER = RecorderMetrics(
    id="r", time_s=1.0, refused=0, episodes=12, bytes=3_400_000, dropped=0, deleted=0
)


def view_of(*metrics: Metrics) -> RunView:
    return RunView(RUN, {(m.role, m.id): m for m in metrics}, {})
