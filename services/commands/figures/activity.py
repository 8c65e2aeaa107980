"""`vmdnn figure activity`."""

from __future__ import annotations

import argparse
from typing import Final

from services.arguments.rollouts import activities_of, add_rollouts
from services.figures import activity
from services.figures.figure_result import FigureResult

SUMMARY: Final = "units and outputs of the network over time (paper, figures 4 and 6)"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the figure's arguments."""
    add_rollouts(parser)


def draw(arguments: argparse.Namespace) -> FigureResult:
    """Read the rollouts and draw them side by side."""
    activities = activities_of(arguments, activity.SUBNETS)
    return FigureResult(
        activity.draw(activities), activity.numbers(activities), activity.table(activities)
    )
