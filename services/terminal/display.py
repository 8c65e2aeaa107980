"""Showing the state of a run again and again, as it changes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Final

from rich.console import Console
from rich.live import Live

from services.board import RunView
from services.terminal.run_tables import run_tables
from services.terminal.run_words import run_line

LINES_PERIOD_S: Final = 5.0
"""Least time between two lines, where the output is no terminal."""

Show = Callable[[RunView], None]


def display(console: Console) -> AbstractContextManager[Show]:
    """Gives a function to call with each new view of a run.

    On a terminal it updates tables in place; elsewhere it prints a line now and then.
    """
    return _tables(console) if console.is_terminal else _lines(console)


@contextmanager
def _tables(console: Console) -> Iterator[Show]:
    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
        yield lambda view: live.update(run_tables(view), refresh=True)


@contextmanager
def _lines(console: Console) -> Iterator[Show]:
    due_s = time.monotonic() + LINES_PERIOD_S
    last = ""

    def show(view: RunView) -> None:
        nonlocal due_s, last
        line = run_line(view)
        if time.monotonic() >= due_s and line != last:
            console.print(f"{time.strftime('%H:%M:%S')} {line}", soft_wrap=True, highlight=False)
            due_s, last = time.monotonic() + LINES_PERIOD_S, line

    yield show
