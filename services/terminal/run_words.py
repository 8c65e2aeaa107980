"""The state of a run in words."""

from __future__ import annotations

from collections.abc import Sequence

from proto.metrics import ActorMetrics, LearnerMetrics, PolicyScore, Stage, Success, SuiteScore
from services.board import RunView


def run_line(view: RunView) -> str:
    """The state of a run in one line."""
    parts = [
        *map(_learner_words, view.living(LearnerMetrics)),
        actors_words(view.living(ActorMetrics)),
        *map(_score_words, view.scores[-1:]),
        *filter(None, map(_suite_words, view.suites[1:])),
    ]
    if view.vanished_s:
        parts.append("gone: " + ", ".join(f"{role} {name}" for role, name in view.vanished_s))
    return " | ".join(parts)


def success_words(success: Success, trials: int) -> str:
    """Such as `8 of 12, 67 % (39 to 86)`: successes, rate and Wilson interval in percent."""
    low, high = success.wilson95
    return (
        f"{success.successes} of {trials}, "
        f"{100 * success.rate:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
    )


def stage_words(learner: LearnerMetrics) -> str:
    """Such as `coupled`, `coupled, round 2`, or what the learner waits for."""
    if learner.stage is not Stage.WAITING:
        in_round = learner.round and learner.stage is Stage.COUPLED
        return f"{learner.stage}, round {learner.round}" if in_round else learner.stage
    if not learner.corrections_total:
        return "waiting for sequences"
    return f"waiting for corrections {learner.corrections}/{learner.corrections_total}"


def actors_words(actors: Sequence[ActorMetrics]) -> str:
    """How many actors there are and what they do together."""
    speed = sum(actor.steps_per_s for actor in actors)
    episodes = sum(actor.episodes for actor in actors)
    count = "1 actor" if len(actors) == 1 else f"{len(actors)} actors"
    return f"{count}, {speed:.0f} steps/s, {episodes} episodes"


def _learner_words(learner: LearnerMetrics) -> str:
    words = [f"learner {stage_words(learner)}"]
    if learner.epochs_total:
        words.append(f"epoch {learner.epoch}/{learner.epochs_total}")
    if learner.loss is not None:
        words.append(f"loss {learner.loss:.4f}")
    words.append(f"{learner.sequences} sequences, {learner.epochs_per_s:.1f} epochs/s")
    if learner.given_up:
        words.append(f"{learner.given_up} given up")
    words.append(f"policy {learner.policy_version}")
    return ", ".join(words)


def _suite_words(suite: SuiteScore) -> str:
    """Such as `beyond strict 8 of 12, 67 % (39 to 86)`; empty if nothing is known of it."""
    if suite.unplayable:
        return f"{suite.name} is not played: {suite.unplayable}"
    if not suite.policies:
        return ""
    score = suite.policies[-1]
    return f"{suite.name} strict {success_words(score.strict, score.trials)}"


def _score_words(score: PolicyScore) -> str:
    return f"policy {score.version} strict {success_words(score.strict, score.trials)}"
