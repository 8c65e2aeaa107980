"""Texts from outside are shown in one line, without control codes and without markup."""

from __future__ import annotations

import io
import logging
from argparse import Namespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from rich.table import Table
from run_metrics import ACTOR, EVALUATOR, LEARNER, view_of

from proto.plain_text import plain, plain_lines
from services.arguments.logs import ProcessLog
from services.board import RunView
from services.terminal.console import make_console
from services.terminal.display import display
from services.terminal.run_progress import ProgressMeter
from services.terminal.run_tables import run_tables
from services.terminal.run_words import run_line

HOSTILE = ("[/]", "[bold red]", ":warning:", "\x1b[2J", "a\nb", "\r", "\x9b31m", "\u202egnp.exe")
TEXTS = st.text(max_size=60) | st.sampled_from(HOSTILE)


@given(TEXTS)
def test_a_plain_text_is_one_printable_line(text: str) -> None:
    assert plain(text).isprintable()
    if text.isprintable():
        assert plain(text) == text
    lines = plain_lines(text).split("\n")
    assert len(lines) == text.count("\n") + 1
    assert all(line.isprintable() for line in lines)


def test_a_long_text_is_cut_off() -> None:
    assert plain("a" * 100, 10) == "a" * 10 + "..."
    assert len(plain("\x00" * 10_000_000)) < 10_000


def hostile_view(text: str) -> RunView:
    """A view of processes that call themselves something hostile, as no decoder lets it through."""
    odd = {"id": text, "backend": text, "last_outcome": text}
    return view_of(
        *(type(ACTOR)(**{**vars(ACTOR), **odd}), type(LEARNER)(**{**vars(LEARNER), "id": text})),
        EVALUATOR,
    )


@given(TEXTS)
@settings(max_examples=40)
def test_a_view_shows_hostile_texts_as_texts(text: str) -> None:
    console = make_console()
    console.file = io.StringIO()
    console.print(run_tables(hostile_view(text)))
    with display(console, ProgressMeter(), {}) as show:
        show(hostile_view(text))
    assert "\x1b" not in console.file.getvalue()
    assert plain(run_line(hostile_view(text))).isprintable()


def test_a_table_shows_markup_as_text() -> None:
    table = Table("name", title="[/]")
    table.add_row("[/] [bold]x[/bold] :warning:")
    console = make_console()
    console.file = io.StringIO()
    console.print(table)
    assert "[/] [bold]x[/bold] :warning:" in console.file.getvalue()


def test_a_view_that_cannot_be_shown_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    broken = RunView("run", None, {})  # type: ignore[arg-type]
    with display(Console(file=io.StringIO(), force_terminal=True), ProgressMeter(), {}) as show:
        show(broken)
    assert "cannot be shown" in caplog.text


def test_a_log_record_cannot_look_like_two(capfd: pytest.CaptureFixture[str]) -> None:
    root = logging.getLogger()
    before = root.handlers[:], root.level
    try:
        ProcessLog("actor", Namespace(log_format="text", quiet=False, verbose=False))
        forged = "2026-01-01 00:00:00,000 learner ERROR lost everything"
        logging.getLogger("test").warning("refused: %s", f"x\n{forged}\x1b[2J")
        try:
            raise ValueError(f"y\n{forged}")
        except ValueError:
            logging.getLogger("test").exception("failed")
    finally:
        root.handlers[:], root.level = before
    printed = capfd.readouterr().err
    assert forged in printed
    assert "\x1b" not in printed
    assert not any(line.startswith(forged[:10]) for line in printed.splitlines())
