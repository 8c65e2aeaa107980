"""`vmdnn figure`: draw a figure of the paper, or one of a run's training or failures."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final, Protocol

from services.commands.figures import (
    activity,
    corrections,
    failures,
    gestures,
    memory,
    time_constants,
    timeline,
    training,
    trajectories,
)
from services.figures.figure_result import FigureResult
from services.figures.style import check_name, save
from services.terminal.console import make_console


class FigureCommand(Protocol):
    """A module that draws one figure."""

    SUMMARY: str

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the figure's arguments, except --out and --json."""

    def draw(self, arguments: argparse.Namespace) -> FigureResult:
        """Compute the numbers and draw the figure."""


FIGURES: Final[Mapping[str, FigureCommand]] = {
    "activity": activity,
    "trajectories": trajectories,
    "memory": memory,
    "time-constants": time_constants,
    "failures": failures,
    "corrections": corrections,
    "gestures": gestures,
    "training": training,
    "timeline": timeline,
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add a subcommand for each figure."""
    subparsers = parser.add_subparsers(dest="figure", metavar="NAME", required=True)
    for name, figure in FIGURES.items():
        subparser = subparsers.add_parser(
            name,
            help=figure.SUMMARY,
            description=f"{figure.SUMMARY[0].upper()}{figure.SUMMARY[1:]}.",
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )
        figure.configure(subparser)
        subparser.add_argument("--out", type=Path, required=True, help="PNG file to write")
        subparser.add_argument("--json", action="store_true", help="print the numbers as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Draw the figure and print its numbers."""
    check_name(arguments.out)  # first, because drawing can take hours
    drawn = FIGURES[arguments.figure].draw(arguments)
    save(drawn.figure, arguments.out)
    if arguments.json:
        print(json.dumps(drawn.numbers))
    else:
        make_console().print(drawn.table)
        print(arguments.out)
    return 0
