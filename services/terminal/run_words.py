"""The state of a run in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from proto.episode import NO_FAILURE
from proto.keys import Role
from proto.metrics import (
    ActorMetrics,
    EvaluatorMetrics,
    LearnerMetrics,
    PolicyScore,
    RecorderMetrics,
    Stage,
    Success,
    SuiteScore,
)
from services.board import RunView
from services.terminal.run_progress import Progress, counted_trials

_STAGES: Final[Mapping[Stage, str]] = {
    Stage.WAITING: "waiting",
    Stage.PRETRAINING: "pre-training",
    Stage.COUPLED: "coupled training",
    Stage.FINISHED: "finished",
}
_UNUSUAL_WAITS: Final = ("the hub", "the disk", "the end of")
"""How the texts begin that say what a process waits for, if this is no part of its work."""
_NO_PROCESSES: Final[Mapping[Role, int]] = {}


def run_line(
    view: RunView, progress: Progress | None = None, expected: Mapping[Role, int] = _NO_PROCESSES
) -> str:
    """The state of a run in one line.

    Args:
        view: the state.
        progress: how far it is in time.
        expected: number of processes by role that were started.
    """
    parts = [
        goal_words(view, progress or Progress()),
        starting_words(view, expected),
        *(f"learner: {learner_words(each)}" for each in view.living(LearnerMetrics)),
        *(f"evaluator: {evaluator_words(view, each)}" for each in view.living(EvaluatorMetrics)),
        actors_words(view.living(ActorMetrics)),
        *map(_score_words, view.scores[-1:]),
        *map(_suite_words, view.suites[1:]),
    ]
    parts += [*unusual_waits(view), *expiry_words(view)]
    if view.vanished_s:
        parts.append("gone: " + ", ".join(f"{role} {name}" for role, name in view.vanished_s))
    return " | ".join(filter(None, parts))


def goal_words(view: RunView, progress: Progress) -> str:
    """Such as `policy 2 of 4, 1 min 12 s so far, about 3 min left`; empty if nothing is known."""
    learners = view.living(LearnerMetrics)
    words = [f"policy {each.policy_version} of {each.policies_total}" for each in learners[:1]]
    if progress.elapsed_s is not None:
        words.append(f"{duration_words(progress.elapsed_s)} so far")
    if progress.left_s is not None:
        about = "more than" if progress.at_least else "about"
        words.append(f"{about} {_rounded_words(progress.left_s)} left")
    return ", ".join(words)


def starting_words(view: RunView, expected: Mapping[Role, int]) -> str:
    """Such as `starting learner and 2 actors (...)`; empty if all that were started are there.

    Args:
        view: the state of the run.
        expected: number of processes by role that were started; empty if this is not known.
    """
    if not expected and not view.metrics:
        return "no process of this run is there"
    known = [role for role, _ in {*view.metrics, *view.vanished_s}]
    missing = {role: count - known.count(role) for role, count in expected.items()}
    names = [
        _actors_count(count) if role is Role.ACTOR else role.value
        for role, count in missing.items()
        if count > 0
    ]
    if not names:
        return ""
    words = "starting " + _listed(names)
    if missing.get(Role.ACTOR, 0) > 0:
        words += " (an actor takes up to half a minute to build its simulator)"
    return words


def unusual_waits(view: RunView) -> list[str]:
    """Such as `learner l waits for the hub`, of each process that waits for what should be there.

    What an actor waits for is told with the actor.
    """
    return [
        f"{role} {name} waits for {metrics.waiting_for}"
        for (role, name), metrics in sorted(view.metrics.items())
        if role is not Role.ACTOR
        and (role, name) not in view.vanished_s
        and metrics.waiting_for.startswith(_UNUSUAL_WAITS)
    ]


def expiry_words(view: RunView) -> list[str]:
    """Such as `the certificates of hub h and 3 more expire in 12 days: ...`; empty if none does."""
    expiring = sorted(
        (metrics.certificate_days, role, name)
        for (role, name), metrics in view.metrics.items()
        if metrics.certificate_days is not None and (role, name) not in view.vanished_s
    )
    if not expiring:
        return []
    days, role, name = expiring[0]
    more = len(expiring) - 1
    whose = (
        f"certificates of {role} {name} and {more} more"
        if more
        else f"certificate of {role} {name}"
    )
    when = {0: "today", 1: "tomorrow"}.get(days, f"in {days} days")
    verb = "expire" if more else "expires"
    return [f"the {whose} {verb} {when}: deploy/certificates.sh --renew makes new ones"]


def success_words(success: Success, trials: int) -> str:
    """Such as `8 of 12, 67 % (39 to 86)`: successes, rate and Wilson interval in percent."""
    return f"{success.successes} of {trials}, {percent_words(success)}"


def percent_words(success: Success) -> str:
    """Such as `67 % (39 to 86)`: rate and Wilson interval in percent."""
    low, high = success.wilson95
    return f"{100 * success.rate:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def outcome_words(reason: str) -> str:
    """The reason of an outcome in words, such as `not lifted`; `success` for a precise one."""
    return "success" if reason == NO_FAILURE else reason.replace("_", " ")


def reasons_words(score: PolicyScore) -> str:
    """Such as `moved object 4, imprecise 2`: why trials were not precise, most frequent first."""
    reasons = sorted(score.reasons.items(), key=lambda item: -item[1])
    return ", ".join(f"{outcome_words(reason)} {count}" for reason, count in reasons)


def duration_words(seconds: float) -> str:
    """Such as `45 s`, `3 min 12 s` or `2 h 5 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def stage_words(learner: LearnerMetrics) -> str:
    """Such as `coupled training, round 2 of 4`, or what the learner waits for."""
    if learner.stage is not Stage.WAITING:
        in_round = learner.round and learner.stage is Stage.COUPLED
        words = _STAGES[learner.stage]
        return f"{words}, round {learner.round} of {learner.rounds}" if in_round else words
    if not learner.corrections_total:
        return f"waiting for sequences: {sequences_words(learner)}"
    return (
        f"waiting for corrections of round {learner.round} of {learner.rounds}:"
        f" {learner.corrections} of {learner.corrections_total}"
    )


def sequences_words(learner: LearnerMetrics) -> str:
    """Such as `13 of 45 sequences`, or `45 sequences` when all have come."""
    if learner.sequences_total > learner.sequences:
        return f"{learner.sequences} of {learner.sequences_total} sequences"
    return "1 sequence" if learner.sequences == 1 else f"{learner.sequences} sequences"


def learner_words(learner: LearnerMetrics) -> str:
    """What the learner does, such as `coupled training, epoch 20 of 60, loss 0.1234, ...`."""
    words = ["paused"] if learner.paused else []
    words.append(stage_words(learner))
    if learner.stage in (Stage.PRETRAINING, Stage.COUPLED):
        words.append(f"epoch {learner.epoch} of {learner.epochs_total}")
    if learner.loss is not None:
        words.append(f"loss {learner.loss:.4f}")
    if learner.epochs_per_s:
        words.append(f"{learner.epochs_per_s:.1f} epochs/s")
    if learner.stage is not Stage.WAITING or learner.corrections_total:
        words.append(sequences_words(learner))
    if learner.given_up:
        words.append(f"{learner.given_up} given up")
    return ", ".join(words)


def evaluator_words(view: RunView, evaluator: EvaluatorMetrics) -> str:
    """Such as `4 of 10 trials of policy 2`, or what the evaluator waits for."""
    if evaluator.paused:
        return "paused"
    version = view.policy_version
    if not version:
        return "waiting for the first policy"
    wanted = sum(suite.trials for suite in evaluator.suites)
    counted = counted_trials(evaluator.suites, version)
    suites = f" in {len(evaluator.suites)} suites" if len(evaluator.suites) > 1 else ""
    words = f"{counted} of {wanted} trials of policy {version}{suites}"
    if counted >= wanted and evaluator.leases:
        words += f", {evaluator.leases} of earlier ones being played"
    return words


def recorder_words(recorder: RecorderMetrics) -> str:
    """Such as `12 episodes, 3.4 MB`."""
    words = f"{recorder.episodes} episodes, {recorder.bytes / 1e6:.1f} MB"
    return f"{words}, {recorder.dropped} dropped" if recorder.dropped else words


def actors_words(actors: Sequence[ActorMetrics]) -> str:
    """How many actors there are and what they do together."""
    speed = sum(actor.steps_per_s for actor in actors)
    episodes = sum(actor.episodes for actor in actors)
    words = [_actors_count(len(actors))]
    if actors and all(map(waits_for_policy, actors)):
        words.append("waiting for the first policy")
    elif actors:
        words.append(f"{speed:.0f} steps/s")
    words.append("1 episode" if episodes == 1 else f"{episodes} episodes")
    return ", ".join(words) if actors else words[0]


def actor_words(actor: ActorMetrics) -> str:
    """What an actor does: its last episode, or what it waits for."""
    if actor.paused:
        return "paused"
    if waits_for_policy(actor):
        return "waiting for the first policy"
    if actor.waiting_for:
        return f"waiting for {actor.waiting_for}"
    if actor.last_kind is None or actor.last_outcome is None:
        return "first episode"
    return f"{actor.last_kind}: {outcome_words(actor.last_outcome)}"


def waits_for_policy(actor: ActorMetrics) -> bool:
    """Whether an actor has nothing to play until the first policy is published."""
    return not actor.policy_version and actor.waiting_for == "the first policy"


def _actors_count(count: int) -> str:
    return "1 actor" if count == 1 else f"{count} actors" if count else "no actor"


def _rounded_words(seconds: float) -> str:
    """A time as an estimate gives it: 5 s, 10 s, ... 55 s, 1 min, 2 min, ... 1 h 10 min."""
    if seconds < 57.5:
        return f"{max(5, 5 * round(seconds / 5))} s"
    minutes = round(seconds / 60)
    if minutes < 60:
        return f"{minutes} min"
    tens = 10 * round(minutes / 10)
    return f"{tens // 60} h {tens % 60} min" if tens % 60 else f"{tens // 60} h"


def _listed(names: Sequence[str]) -> str:
    """Such as `learner, evaluator and 2 actors`."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


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
