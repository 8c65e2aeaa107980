"""Every tutored sequence on disk: one MCAP file each, named by the episode's id."""

from __future__ import annotations

import logging
from pathlib import Path
from threading import Lock

from proto.episode import Episode
from proto.errors import UserError
from proto.recordings.episodes import read_episode, write_episode

_log = logging.getLogger(__name__)


class TutoringStore:
    """Sequences in a folder; they are there again when a store of that folder is made again.

    May be added to in one thread and read in another. A file that cannot be read is left where it
    is, reported once, and counts as missing: its episode may be added again.

    Attributes:
        folder: where the files are; it need not exist before the first one.
        damaged: what is wrong with each file that could not be read, by id.
    """

    def __init__(self, folder: Path) -> None:
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
        """Keep an episode; it is on disk on return. False if it was there already.

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
        try:
            return read_episode(self._path(sequence))
        except UserError as error:
            _log.warning("tutoring sequence ignored: %s", error)
            with self._lock:
                self._ids.discard(sequence)
                self.damaged[sequence] = str(error)
            return None

    def _path(self, sequence: str) -> Path:
        return self.folder / f"{sequence}.mcap"
