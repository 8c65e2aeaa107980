"""Showing the state of a run again and again, as it changes."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import Final

from rich.console import Console
from rich.live import Live
from rich.text import Text

from proto.keys import Role
from proto.plain_text import plain
from services.board import RunView
from services.terminal.run_progress import ProgressMeter
from services.terminal.run_tables import fitting_tables
from services.terminal.run_words import run_line

LOG = logging.getLogger(__name__)

LINES_PERIOD_S: Final = 5.0
"""Least time between two lines, where the output is no terminal."""

Show = Callable[[RunView], None]


def display(
    console: Console, meter: ProgressMeter, expected: Mapping[Role, int]
) -> AbstractContextManager[Show]:
    """Gives a function to call with each new view of a run.

    On a terminal it updates tables in place; elsewhere it prints a line now and then. A view that
    cannot be shown is logged and left out, because showing must not end a run.

    Args:
        console: where to show it.
        meter: estimates what is left of the run.
        expected: number of processes by role that were started; empty if this is not known.
    """
    show = _tables if console.is_terminal else _lines
    return _safe(show(console, meter, expected))


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
def _tables(console: Console, meter: ProgressMeter, expected: Mapping[Role, int]) -> Iterator[Show]:
    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
        yield lambda view: live.update(
            fitting_tables(view, console, meter.look(view), expected), refresh=True
        )


@contextmanager
def _lines(console: Console, meter: ProgressMeter, expected: Mapping[Role, int]) -> Iterator[Show]:
    due_s = time.monotonic()
    last = ""

    def show(view: RunView) -> None:
        nonlocal due_s, last
        progress = meter.look(view)
        state = run_line(view, expected=expected)
        if time.monotonic() >= due_s and state != last:
            line = run_line(view, progress, expected)
            text = Text(plain(f"{time.strftime('%H:%M:%S')} {line}"))
            console.print(text, soft_wrap=True, highlight=False)
            due_s, last = time.monotonic() + LINES_PERIOD_S, state

    yield show
