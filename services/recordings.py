"""The recordings of a run, and which of them are deleted when there are too many."""

from __future__ import annotations

import logging
from collections import OrderedDict
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from proto.config import KeepConfig
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.recordings.episodes import read_heading
from proto.storage import delete_file, parts_in

LOG = logging.getLogger(__name__)

GIB: Final = 2**30


class Recordings:
    """The recordings in a folder.

    Attributes:
        folder: where they are.
        deleted: number of recordings of practice that were deleted since the process started.
    """

    def __init__(self, folder: Path, keep: KeepConfig) -> None:
        """Look at the recordings in a folder, and delete what is left of unfinished ones."""
        self.folder = folder
        self.deleted = 0
        self._keep = keep
        self._bytes = 0
        self._practice: OrderedDict[Path, int] = OrderedDict()  # sizes, the oldest first
        self._told = False
        for unfinished in parts_in(folder):
            delete_file(unfinished)
        files = {path: path.stat() for path in folder.glob("*.mcap")}
        for path in sorted(files, key=lambda path: files[path].st_mtime_ns):
            try:
                self.add(path, read_heading(path).kind)
            except UserError as error:
                self._bytes += files[path].st_size
                LOG.warning("is kept, and counted in no limit: %s", error)

    def path(self, episode: Episode) -> Path:
        """Where an episode is recorded; the names sort by the time at which it was played."""
        former = self.folder / f"{episode.id}.mcap"  # as vmdnn 0.1 named it
        if episode.started_s is None or former.exists():
            return former
        played = datetime.fromtimestamp(episode.started_s, UTC)
        stamp = f"{played:%Y%m%d-%H%M%S}-{played.microsecond // 1000:03d}"
        return self.folder / f"{stamp}_{episode.id}.mcap"

    def add(self, path: Path, kind: Kind) -> None:
        """Note that a file was written, and delete the oldest practice if there is too much."""
        size = path.stat().st_size
        self._bytes += size
        if kind is Kind.PRACTICE:
            self._practice[path] = size
        while self._practice and self._too_many:
            oldest, freed = self._practice.popitem(last=False)
            delete_file(oldest)
            self._bytes -= freed
            self.deleted += 1
        if self._too_large and not self._told:
            self._told = True
            LOG.warning(
                "the recordings of trials alone are larger than recorder.keep.gib = %g; trials are "
                "never deleted",
                self._keep.gib,
            )

    @property
    def _too_large(self) -> bool:
        return self._bytes > self._keep.gib * GIB

    @property
    def _too_many(self) -> bool:
        return self._too_large or len(self._practice) > self._keep.practice
