"""The state of a run as tables."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from proto.metrics import (
    ActorMetrics,
    LearnerMetrics,
    PolicyScore,
    RecorderMetrics,
    SuiteScore,
)
from proto.plain_text import plain
from services.board import RunView
from services.terminal.run_words import actors_words, stage_words, success_words

ROWS_SHOWN: Final = 12
"""A table shows no more actors, and no more policy versions."""


def run_tables(view: RunView) -> RenderableType:
    """The state of a run as tables."""
    parts: list[RenderableType] = [Text(plain(f"run {view.run}"), style="bold")]
    parts += [_learner_table(learner) for learner in view.living(LearnerMetrics)]
    parts.append(_actors_table(view.living(ActorMetrics)))
    if view.scores:
        parts.append(_scores_table(view.scores))
    if len(view.suites) > 1:
        parts.append(_suites_table(view.suites))
    parts += [
        Text(f"suite {suite.name} is not played: {suite.unplayable}", style="red")
        for suite in view.suites
        if suite.unplayable
    ]
    parts += [
        _text(
            f"recorder {m.id}: {m.episodes} episodes, {m.bytes / 1e6:.1f} MB, {m.dropped} dropped"
        )
        for m in view.living(RecorderMetrics)
    ]
    parts += [
        Text(plain(f"{role} {name} waits for {metrics.waiting_for}"))
        for (role, name), metrics in sorted(view.metrics.items())
        if metrics.waiting_for and (role, name) not in view.vanished_s
    ]
    parts += [
        Text(plain(f"{role} {name} is gone for {time.time() - since_s:.0f} s"), style="red")
        for (role, name), since_s in sorted(view.vanished_s.items())
    ]
    return Group(*parts)


def _learner_table(learner: LearnerMetrics) -> Table:
    table = Table("learner", "stage", "epoch", "", "loss", "sequences", "epochs/s", "policy")
    table.add_row(
        _text(learner.id),
        "paused" if learner.paused else stage_words(learner),
        f"{learner.epoch}/{learner.epochs_total}",
        ProgressBar(total=max(learner.epochs_total, 1), completed=learner.epoch, width=20),
        "" if learner.loss is None else f"{learner.loss:.4f}",
        str(learner.sequences),
        f"{learner.epochs_per_s:.1f}",
        str(learner.policy_version),
    )
    return table


def _actors_table(actors: Sequence[ActorMetrics]) -> Table:
    table = Table("actor", "policy", "steps/s", "episodes", "last episode", "outbox", "simulator")
    for actor in actors[:ROWS_SHOWN]:
        last = f"{actor.last_kind}: {actor.last_outcome}" if actor.last_kind else ""
        table.add_row(
            _text(actor.id),
            str(actor.policy_version),
            f"{actor.steps_per_s:.1f}",
            str(actor.episodes),
            _text("paused" if actor.paused else last),
            _outbox_words(actor),
            _text(actor.backend),
        )
    if len(actors) > ROWS_SHOWN:
        table.caption = f"and {len(actors) - ROWS_SHOWN} more; all: {actors_words(actors)}"
    return table


def _text(text: str) -> Text:
    """A text from a message: shown as it is, without markup and control codes."""
    return Text(plain(text, 100))


def _outbox_words(actor: ActorMetrics) -> str:
    """Such as `2`, or `2, 1 put aside`."""
    aside = f", {actor.put_aside} put aside" if actor.put_aside else ""
    return f"{actor.outbox}{aside}"


def _scores_table(scores: Sequence[PolicyScore]) -> Table:
    table = Table("policy", "trials", "lenient", "strict", "precise", "not precise because")
    for score in reversed(scores[-ROWS_SHOWN:]):
        table.add_row(str(score.version), str(score.trials), *_score_cells(score))
    return table


def _suites_table(suites: Sequence[SuiteScore]) -> Table:
    """The newest policy version that was tried in each suite."""
    table = Table(
        *("suite", "simulator", "policy", "trials", "lenient", "strict", "precise"),
        "not precise because",
    )
    for suite in suites:
        score = suite.policies[-1] if suite.policies else None
        table.add_row(
            suite.name,
            suite.backend,
            "" if score is None else str(score.version),
            f"{0 if score is None else score.trials}/{suite.trials}",
            *(() if score is None else _score_cells(score)),
        )
    return table


def _score_cells(score: PolicyScore) -> tuple[str, ...]:
    """The three readings of success, and the reasons of what was not precise."""
    reasons = sorted(score.reasons.items(), key=lambda item: -item[1])
    return (
        *(success_words(s, score.trials) for s in (score.lenient, score.strict, score.precise)),
        ", ".join(f"{reason} {count}" for reason, count in reasons if reason != "none"),
    )
