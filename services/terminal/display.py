"""Showing the state of a run again and again, as it changes."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Final

from rich.console import Console
from rich.live import Live
from rich.text import Text

from proto.plain_text import plain
from services.board import RunView
from services.terminal.run_tables import run_tables
from services.terminal.run_words import run_line

LOG = logging.getLogger(__name__)

LINES_PERIOD_S: Final = 5.0
"""Least time between two lines, where the output is no terminal."""

Show = Callable[[RunView], None]


def display(console: Console) -> AbstractContextManager[Show]:
    """Gives a function to call with each new view of a run.

    On a terminal it updates tables in place; elsewhere it prints a line now and then. A view that
    cannot be shown is logged and left out, because showing must not end a run.
    """
    return _safe(_tables(console) if console.is_terminal else _lines(console))


@contextmanager
def _safe(display: AbstractContextManager[Show]) -> Iterator[Show]:
    with display as show_view:

        def show(view: RunView) -> None:
            try:
                show_view(view)
            except OSError:  # such as the end of the pipe that is written to
                raise
            except Exception:
                LOG.exception("the state of the run %s cannot be shown", plain(view.run))

        yield show


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
            text = Text(plain(f"{time.strftime('%H:%M:%S')} {line}"))
            console.print(text, soft_wrap=True, highlight=False)
            due_s, last = time.monotonic() + LINES_PERIOD_S, line

    yield show
