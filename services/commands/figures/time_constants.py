"""`vmdnn figure time-constants`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from actors.tasks.registry import make_task
from services.arguments.common import add_config, add_playing, playing_config
from services.arguments.sweeping import add_sweep, run_sweep
from services.arguments.training import add_training_data, training_stores
from services.figures import time_constants
from services.figures.figure_result import FigureResult
from services.trials.sweeps import Variant

SUMMARY: Final = "train and test networks by their PFC's time constant (paper, figure 5)"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the figure's arguments."""
    add_config(parser)
    add_playing(parser)
    add_training_data(parser)
    parser.add_argument(
        "--tau",
        type=float,
        nargs="+",
        default=[30.0, 70.0, 110.0, 150.0, 210.0],
        help="time constants of the PFC",
    )
    add_sweep(parser, trials=52)
    parser.add_argument(
        "--work",
        type=Path,
        help="folder of the networks and their trials; the same command continues with it;"
        " without it, --out without .png",
    )


def draw(arguments: argparse.Namespace) -> FigureResult:
    """Train and test the networks that are not done yet, then draw the success of all."""
    config = playing_config(arguments)
    stores = training_stores(arguments)
    variants = [
        Variant.of(f"tau{tau:g}", config, {"network.pfc.tau": tau}) for tau in arguments.tau
    ]
    tested = run_sweep(arguments, variants, work_folder(arguments), lambda _: stores)
    tallies = time_constants.tallies_of(tested)
    published = time_constants.published_rates(make_task(config.task).figure_words)
    return FigureResult(
        time_constants.draw(tallies, published),
        time_constants.numbers(tallies, published),
        time_constants.table(tallies),
    )


def work_folder(arguments: argparse.Namespace) -> Path:
    """Return the folder of the networks and their trials."""
    folder: Path = arguments.work or arguments.out.with_suffix("")
    return folder
