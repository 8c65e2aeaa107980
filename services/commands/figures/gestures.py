"""`vmdnn figure gestures`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from proto.errors import UserError
from services.arguments.common import positive
from services.figures import gestures
from services.figures.figure_result import FigureResult
from sim_assets.gestures.clip import GestureLibrary
from sim_assets.gestures.drawing import DrawnGestures
from sim_assets.gestures.videos import GestureVideoError, RecordedGestures

SUMMARY: Final = "contact sheet of the clips in which a person points (Experiment II)"
TAKES: Final = 10
"""Number of takes of a drawn subject, as in the paper."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the figure's arguments."""
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--subjects",
        type=positive,
        default=8,
        help="number of drawn subjects to show; for a single one, all takes are shown",
    )
    source.add_argument(
        "--gestures",
        type=Path,
        metavar="DIR",
        help="show the videos of this folder; it holds picture-left/ and picture-right/",
    )


def draw(arguments: argparse.Namespace) -> FigureResult:
    """Draw or read the clips and arrange them on a sheet."""
    rows = gestures.rows_of(_library(arguments))
    return FigureResult(gestures.draw(rows), gestures.numbers(rows), gestures.table(rows))


def _library(arguments: argparse.Namespace) -> GestureLibrary:
    if arguments.gestures is None:
        return DrawnGestures(arguments.subjects, TAKES)
    try:
        return RecordedGestures(arguments.gestures)
    except GestureVideoError as error:
        raise UserError(f"--gestures: {error}") from error
