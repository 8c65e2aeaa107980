"""`vmdnn figure trajectories`."""

from __future__ import annotations

import argparse
from typing import Final

from services.arguments.common import integer
from services.arguments.rollouts import activities_of, add_rollouts
from services.figures import trajectories
from services.figures.figure_result import FigureResult
from services.figures.rollouts import SYMBOLS
from services.figures.trajectories import Trajectories

SUMMARY: Final = "trajectories of a subnet's states in several rollouts (paper, figure 7)"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the figure's arguments."""
    add_rollouts(parser)
    parser.add_argument("--subnet", choices=SYMBOLS, default="pfc", help="subnet to show")
    parser.add_argument(
        "--units",
        type=integer(0),
        nargs=2,
        metavar=("I", "J"),
        help="two units to show, counted from 0; without it, the two that vary most",
    )


def draw(arguments: argparse.Namespace) -> FigureResult:
    """Read the rollouts and draw their trajectories."""
    activities = activities_of(arguments, [arguments.subnet])
    units = None if arguments.units is None else (arguments.units[0], arguments.units[1])
    found = Trajectories.of(activities, arguments.subnet, units)
    return FigureResult(
        trajectories.draw(found), trajectories.numbers(found), trajectories.table(found)
    )
