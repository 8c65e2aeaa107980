"""Which recordings are exported."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from proto.episode import Episode
from proto.errors import UserError
from proto.recordings.episodes import read_episode

FOLDERS_OF_A_RUN: Final = ("tutoring", "rollouts")


def recordings_in(paths: Iterable[Path]) -> list[Path]:
    """Return the recordings that some paths name, each path's sorted by name.

    Args:
        paths: recordings, or folders: all recordings (`*.mcap`) in a folder, and in `tutoring` and
            `rollouts` in it, as in the folder of a run.

    Raises:
        UserError: a path does not exist, or holds no recording.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_file():
            found.append(path)
            continue
        if not path.is_dir():
            raise UserError(f"{path}: there is no such file or folder")
        inside = [
            file
            for folder in (path, *(path / name for name in FOLDERS_OF_A_RUN))
            for file in sorted(folder.glob("*.mcap"))
        ]
        if not inside:
            raise UserError(
                f"{path} holds no recording (*.mcap), nor do {' and '.join(FOLDERS_OF_A_RUN)} in it"
            )
        found += inside
    return found


def read_each(files: Sequence[Path]) -> Iterator[Episode]:
    """Yield the episode of each recording.

    Raises:
        UserError: a recording cannot be read.
    """
    return map(read_episode, files)


def common_period_s(episodes: Iterable[Episode]) -> float:
    """Return the control period (s) that all episodes share.

    Raises:
        UserError: they have different ones.
    """
    periods = sorted({episode.control_period_s for episode in episodes})
    if len(periods) != 1:
        raise UserError(f"the recordings have different control periods (s): {periods}")
    return periods[0]
