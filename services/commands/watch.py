"""`vmdnn watch`: show what all processes of a run are doing."""

from __future__ import annotations

import argparse
import json
import os
import sys
from typing import Final

from proto.lifecycle import Lifecycle
from proto.membership import METRICS_PERIOD_S
from services.arguments.common import add_connection, config_of
from services.arguments.watching import add_wait, open_bus_within
from services.board import Board, RunView
from services.terminal.console import make_console
from services.terminal.display import display
from services.terminal.run_progress import ProgressMeter
from services.terminal.run_tables import WIDE, run_tables

ONCE_WITHIN_S: Final = 2.5 * METRICS_PERIOD_S


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_connection(parser)
    add_wait(parser)
    parser.add_argument("--once", action="store_true", help="show the current state and end")
    parser.add_argument("--json", action="store_true", help="with --once: print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Show the state of the run until Ctrl-C, or once."""
    config = config_of(arguments)
    with open_bus_within(config, f"watch-{os.getpid()}", arguments.wait) as bus:
        board = Board(bus)
        if arguments.once:
            return _show_once(board.wait_for_all(ONCE_WITHIN_S), arguments.json)
        lifecycle = Lifecycle()
        lifecycle.stop_on_signals()
        with display(make_console(), ProgressMeter(), {}) as show:
            while not lifecycle.stopping:
                show(board.view())
                lifecycle.wait(METRICS_PERIOD_S)
    return 0


def _show_once(view: RunView, as_json: bool) -> int:
    if not view.metrics:
        print(
            f"no process of run {view.run!r} replies; is that the run's name? "
            "Choose another with --set run.name=NAME or --config RUN/config.yaml",
            file=sys.stderr,
        )
        return 1
    if as_json:
        print(json.dumps(view.as_json(), indent=2))
    else:
        console = make_console()
        console.print(run_tables(view, wide=console.width >= WIDE))
    return 0
