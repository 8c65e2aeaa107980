"""`vmdnn figure training`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from proto.errors import UserError
from services.figures import training
from services.figures.figure_result import FigureResult
from services.figures.training import TrainingHistory
from services.monitoring.history import history_file, read_history

SUMMARY: Final = "loss, learning rate, success of each policy version and rates of a run"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the figure's arguments."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="folder of a run")


def draw(arguments: argparse.Namespace) -> FigureResult:
    """Read the history of a run and draw it.

    Raises:
        UserError: the folder has no history, or nothing of it can be read.
    """
    folder: Path = arguments.run_folder
    path = history_file(folder)
    if not path.exists():
        raise UserError(
            f"{folder} has no history ({path.name}); a run's recorder and `vmdnn train` write one"
        )
    past = read_history(path)
    history = TrainingHistory.of(folder.resolve().name, past.samples, past.damaged)
    if not (history.stages or history.scores or history.rates):
        raise UserError(f"{path} holds no sample that can be read ({past.damaged} damaged lines)")
    return FigureResult(training.draw(history), training.numbers(history), training.table(history))
