"""Tutored sequences on disk: one MCAP file each, named by the episode's id."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import TypeVar

from proto.episode import Episode
from proto.errors import UserError
from proto.plain_text import plain
from proto.recordings.episodes import (
    EpisodeSummary,
    read_episode,
    read_summary,
    write_episode,
)
from proto.storage import StorageError, change_suffix

LOG = logging.getLogger(__name__)

Read = TypeVar("Read")


class TutoringStore:
    """The sequences in a folder; another store of the same folder has the same ones.

    One thread may add while another reads. A file that cannot be read is logged once and counts as
    missing: its episode may be added again. It is left where it is, or gets the suffix `.damaged`.

    Attributes:
        folder: where the files are; it is made for the first one.
        damaged: what is wrong with each file that could not be read or was set aside, by id.
    """

    def __init__(self, folder: Path, *, sets_aside: bool = False) -> None:
        """Find the sequences in a folder.

        Args:
            folder: where the files are.
            sets_aside: rename files that cannot be read.
        """
        self._sets_aside = sets_aside
        self.folder = folder
        self.damaged: dict[str, str] = {}
        self._lock = Lock()
        self._ids = {path.stem for path in folder.glob("*.mcap")}

    def __len__(self) -> int:
        return len(self._ids)

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of all sequences, sorted."""
        with self._lock:
            return tuple(sorted(self._ids))

    def add(self, episode: Episode) -> bool:
        """Write an episode to disk. False if the store has it already.

        Raises:
            UserError: it cannot be written.
        """
        with self._lock:
            if episode.id in self._ids:
                return False
            write_episode(self._path(episode.id), episode)
            self.damaged.pop(episode.id, None)
            self._ids.add(episode.id)
            return True

    def load(self, sequence: str) -> Episode | None:
        """Read an episode by its id; None if its file is missing or damaged."""
        return self._read(sequence, read_episode)

    def summary(self, sequence: str) -> EpisodeSummary | None:
        """What a sequence is, without its pictures; None if its file is missing or damaged."""
        return self._read(sequence, read_summary)

    def _read(self, sequence: str, read: Callable[[Path], Read]) -> Read | None:
        try:
            return read(self._path(sequence))
        except UserError as error:
            LOG.warning("tutored sequence ignored: %s", plain(error))
            with self._lock:
                self._ids.discard(sequence)
                self.damaged[sequence] = str(error)
            self._set_aside(self._path(sequence))
            return None

    def set_aside(self, sequence: str, problem: str) -> None:
        """Keep a file out of the store under the suffix `.refused`, and say why.

        Args:
            sequence: id of the sequence.
            problem: what is wrong with it.
        """
        path = self._path(sequence)
        with self._lock:
            self._ids.discard(sequence)
            self.damaged[sequence] = problem
        try:
            kept = f"it is kept as {change_suffix(path, '.refused')}"
        except StorageError as error:
            kept = f"it cannot be renamed: {error}"
        LOG.warning("nothing is learned from %s: %s; %s", path, plain(problem), kept)

    def _set_aside(self, path: Path) -> None:
        if not self._sets_aside or not path.exists():
            return
        try:
            LOG.warning("it is kept as %s", change_suffix(path, ".damaged"))
        except StorageError as error:
            LOG.warning("it cannot be put aside: %s", error)

    def _path(self, sequence: str) -> Path:
        return self.folder / f"{sequence}.mcap"
