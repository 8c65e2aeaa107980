"""The state of a run as tables that fit the terminal."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from proto.keys import Role
from proto.metrics import (
    ActorMetrics,
    EvaluatorMetrics,
    LearnerMetrics,
    PolicyScore,
    RecorderMetrics,
    SuiteScore,
)
from proto.plain_text import plain
from services.board import RunView
from services.terminal.run_progress import Progress
from services.terminal.run_words import (
    actor_words,
    actors_words,
    evaluator_words,
    expiry_words,
    goal_words,
    learner_words,
    percent_words,
    reasons_words,
    recorder_words,
    starting_words,
    unusual_waits,
)

ROWS_SHOWN: Final = 12
"""A table shows no more rows, where the height is not limited."""
WIDE: Final = 100
"""Columns of a terminal from which on the tables have all their columns."""
_LONGEST_ID: Final = 20
_PADDING: Final = (0, 2, 0, 0)
_NO_PROCESSES: Final[Mapping[Role, int]] = {}


def fitting_tables(
    view: RunView, console: Console, progress: Progress, expected: Mapping[Role, int]
) -> RenderableType:
    """The state of a run as tables that are not higher than the terminal.

    If there is too little room, the tables show fewer actors, policy versions and suites.
    """
    shown: RenderableType = Group()
    for rows in range(max(0, console.height - 12), -1, -1):
        shown = run_tables(view, progress, expected, rows=rows, wide=console.width >= WIDE)
        # Live keeps the last line of the terminal for the cursor.
        if len(console.render_lines(shown)) < console.height:
            break
    return shown


def run_tables(
    view: RunView,
    progress: Progress | None = None,
    expected: Mapping[Role, int] = _NO_PROCESSES,
    *,
    rows: int = ROWS_SHOWN,
    wide: bool = True,
) -> RenderableType:
    """The state of a run as tables.

    Args:
        view: the state.
        progress: how far it is in time.
        expected: number of processes by role that were started.
        rows: no table has more rows; with 0 there is only a line for each role.
        wide: show all columns; otherwise only those that fit into 80 columns.
    """
    parts: list[RenderableType] = [
        _headline(view, progress or Progress()),
        *map(_text, filter(None, [starting_words(view, expected)])),
        _processes_table(view),
    ]
    actors = view.living(ActorMetrics)
    if actors and rows:
        parts += [Text(), _actors_table(actors, rows, wide=wide)]
    if view.scores and rows:
        parts += [Text(), _scores_table(view.scores, view.suites[0].trials, rows)]
        if why := reasons_words(view.scores[-1]):
            parts.append(_text(f"policy {view.scores[-1].version}, not precise: {why}"))
    if len(view.suites) > 1 and rows:
        parts += [Text(), _suites_table(view.suites, rows, wide=wide)]
    return Group(*parts, *_problems(view))


def _headline(view: RunView, progress: Progress) -> Text:
    line = Text(plain(f"run {view.run}"), style="bold")
    if goal := goal_words(view, progress):
        line.append(f": {plain(goal)}", style="not bold")
    return line


def _processes_table(view: RunView) -> Table:
    """One line for each role, with what it does."""
    table = Table.grid(padding=_PADDING)
    table.add_column(no_wrap=True)
    table.add_column()
    for learner in view.living(LearnerMetrics):
        table.add_row("learner", _text(learner_words(learner)))
    for evaluator in view.living(EvaluatorMetrics):
        table.add_row("evaluator", _text(evaluator_words(view, evaluator)))
    for recorder in view.living(RecorderMetrics):
        table.add_row("recorder", _text(recorder_words(recorder)))
    actors = view.living(ActorMetrics)
    table.add_row("actors", _text(actors_words(actors) if actors else "none yet"))
    return table


def _table(*headings: str, left: Sequence[str] = ()) -> Table:
    """A table without lines; columns are right-aligned unless they are named in `left`."""
    table = Table(box=None, padding=_PADDING, pad_edge=False, header_style="dim")
    for heading in headings:
        table.add_column(heading, justify="left" if heading in left else "right", no_wrap=True)
    return table


def _actors_table(actors: Sequence[ActorMetrics], rows: int, *, wide: bool) -> Table:
    more = ("simulator", "outbox") if wide else ()
    headings = ("actor", *more, "policy", "steps/s", "episodes", "last episode")
    table = _table(*headings, left=("actor", "simulator", "last episode"))
    table.columns[-1].no_wrap = False
    for actor in actors[:rows]:
        described = (_text(actor.backend), str(actor.outbox)) if wide else ()
        table.add_row(
            _id_text(actor.id),
            *described,
            str(actor.policy_version or ""),
            f"{actor.steps_per_s:.1f}" if actor.steps_per_s else "",
            str(actor.episodes),
            _text(actor_words(actor)),
        )
    if len(actors) > rows:
        table.add_row(_text(f"and {len(actors) - rows} more"))
    return table


def _scores_table(scores: Sequence[PolicyScore], trials: int, rows: int) -> Table:
    table = _table("policy", "trials", "lenient", "strict", "precise")
    for score in reversed(scores[-rows:]):
        table.add_row(str(score.version), f"{score.trials}/{trials}", *_score_cells(score))
    return table


def _suites_table(suites: Sequence[SuiteScore], rows: int, *, wide: bool) -> Table:
    """The newest policy version that was tried in each suite."""
    more = ("simulator",) if wide else ()
    headings = ("suite", *more, "policy", "trials", "lenient", "strict", "precise")
    table = _table(*headings, left=("suite", "simulator"))
    for suite in suites[:rows]:
        score = suite.policies[-1] if suite.policies else None
        described = (_text(suite.backend),) if wide else ()
        table.add_row(
            _id_text(suite.name),
            *described,
            "" if score is None else str(score.version),
            f"{0 if score is None else score.trials}/{suite.trials}",
            *(() if score is None else _score_cells(score)),
        )
    if len(suites) > rows:
        table.add_row(_text(f"and {len(suites) - rows} more"))
    return table


def _score_cells(score: PolicyScore) -> tuple[str, ...]:
    """The three readings of success."""
    return tuple(map(percent_words, (score.lenient, score.strict, score.precise)))


def _problems(view: RunView) -> list[Text]:
    """What needs attention, a line each."""
    lines = [
        f"suite {suite.name} is not played: {suite.unplayable}"
        for suite in view.suites
        if suite.unplayable
    ]
    lines += [
        f"actor {actor.id}: {actor.put_aside} messages put aside, see its log"
        for actor in view.living(ActorMetrics)
        if actor.put_aside
    ]
    lines += [*unusual_waits(view), *expiry_words(view)]
    lines += [
        f"{role} {name} is gone for {time.time() - since_s:.0f} s"
        for (role, name), since_s in sorted(view.vanished_s.items())
    ]
    return [Text(plain(line), style="red") for line in lines]


def _text(text: str) -> Text:
    """A text from a message: shown as it is, without markup and control codes."""
    return Text(plain(text, 200))


def _id_text(name: str) -> Text:
    """An id; of a long one the end, which tells processes of one machine apart."""
    shown = plain(name)
    return Text(shown if len(shown) <= _LONGEST_ID else f"...{shown[3 - _LONGEST_ID :]}")
