"""`vmdnn figure timeline`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from proto.errors import UserError
from proto.recordings.episodes import read_heading
from services.figures import timeline
from services.figures.figure_result import FigureResult
from services.figures.timeline import PlayedEpisode, Timeline
from services.monitoring.history import history_file, read_history
from services.terminal.progress import progress_bar

SUMMARY: Final = "what each process of a run did when, and how long it waited"
_FOLDERS: Final = ("tutoring", "pretraining", "rollouts")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the figure's arguments."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="folder of a run")


def draw(arguments: argparse.Namespace) -> FigureResult:
    """Read the history and the recordings of a run and draw its timeline.

    Raises:
        UserError: the folder has neither.
    """
    folder: Path = arguments.run_folder
    path = history_file(folder)
    samples = read_history(path).samples if path.exists() else []
    found = Timeline.of(folder.resolve().name, samples, _episodes(folder))
    if not found.spans:
        raise UserError(
            f"{folder} has no history ({path.name}) and no recordings; name the folder of a run"
        )
    return FigureResult(timeline.draw(found), timeline.numbers(found), timeline.table(found))


def _episodes(folder: Path) -> Iterator[PlayedEpisode]:
    """Yield the episodes of a run's recordings; those that cannot be read are left out."""
    paths = [path for name in _FOLDERS for path in (folder / name).glob("*.mcap")]
    with progress_bar("reading recordings", len(paths)) as advance:
        for path in paths:
            advance()
            try:
                head = read_heading(path)
                recorded_s = path.stat().st_mtime
            except (UserError, OSError):
                continue
            if head.started_s is not None:
                yield PlayedEpisode(head.actor, head.kind, head.started_s, recorded_s)
