"""What a run has on disk, for people who look at it: recordings, logs, losses of its policies."""

from __future__ import annotations

import logging
import os
import re
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from learner.checkpoint import load_checkpoint
from proto.errors import UserError
from proto.plain_text import plain
from proto.recordings.episodes import EpisodeHeading, read_heading
from proto.senders import is_id
from services.board import Loss
from services.monitoring.history import history_file
from services.monitoring.past_losses import PastLosses

LOG = logging.getLogger(__name__)

RECORDINGS_KEPT: Final = 20_000
"""An archive knows so many recordings; it forgets the oldest."""
FOLDERS: Final = ("tutoring", "rollouts")
POLICIES_SHOWN: Final = 200
LOGS_SHOWN: Final = 64
LINES_SHOWN: Final = 12
LINE_LETTERS: Final = 400
_TAIL_BYTES: Final = 8192
_READ_AT_ONCE: Final = 200
"""Headings that one look reads: there may be many when a viewer starts."""


@dataclass(frozen=True)
class Recording:
    """A recorded episode.

    Attributes:
        number: 1, 2, ... in the order in which the archive found them.
        path: its file.
        heading: what the file says of the episode.
    """

    number: int
    path: Path
    heading: EpisodeHeading


class Archive(Protocol):
    """Recordings that can be looked at."""

    def since(self, number: int) -> Sequence[Recording]:
        """The recordings with a larger number, in the order of their numbers."""

    def path(self, episode: str) -> Path | None:
        """The file of an episode by its id; None if there is none."""


class OneRecording:
    """An archive of one recording."""

    def __init__(self, path: Path) -> None:
        """Read what the recording says of itself.

        Raises:
            UserError: it cannot be read.
        """
        self._recording = Recording(1, path, read_heading(path))

    def since(self, number: int) -> Sequence[Recording]:
        """The recording, unless its number is known."""
        return [self._recording] if number < 1 else []

    def path(self, episode: str) -> Path | None:
        """The file of the recording."""
        return self._recording.path if episode == self._recording.heading.id else None


class RunArchive:
    """The files of a run on this machine, which may grow while it is looked at.

    Attributes:
        folder: the run's folder; it need not exist.
    """

    def __init__(self, folder: Path) -> None:
        """Look at nothing yet."""
        self.folder = folder
        self._lock = threading.Lock()
        self._known: set[Path] = set()
        self._recordings: deque[Recording] = deque(maxlen=RECORDINGS_KEPT)
        self._paths: dict[str, Path] = {}
        self._losses: dict[Path, tuple[int, int, float] | None] = {}
        self._past = PastLosses(history_file(folder))
        self._found = 0

    @property
    def exists(self) -> bool:
        """Whether the run has a folder on this machine."""
        return self.folder.is_dir()

    def look(self) -> None:
        """Find new recordings, the oldest first, and losses; each call reads a limited number."""
        self._past.look()
        present = {path for name in FOLDERS for path in (self.folder / name).glob("*.mcap")}
        self._known &= present
        for path in sorted(present - self._known, key=_written_at_ns)[:_READ_AT_ONCE]:
            self._known.add(path)
            try:
                heading = read_heading(path)
            except UserError as error:
                LOG.warning("is not shown: %s", plain(error, 300))
                continue
            if is_id(heading.id):
                self._add(path, heading)

    def since(self, number: int) -> Sequence[Recording]:
        """The recordings with a larger number, in the order of their numbers."""
        with self._lock:
            new = min(self._found - number, len(self._recordings))
            return list(self._recordings)[-new:] if new > 0 else []

    def path(self, episode: str) -> Path | None:
        """The file of an episode by its id; None if there is none."""
        with self._lock:
            return self._paths.get(episode)

    def tutored(self) -> Sequence[Recording]:
        """The recordings of tutoring and of corrections."""
        with self._lock:
            return [each for each in self._recordings if each.path.parent.name == FOLDERS[0]]

    def newest_policy(self) -> Path | None:
        """The file of the newest policy; None if there is none."""
        return max((self.folder / "policies").glob("*.safetensors"), default=None)

    def past_losses(self) -> Sequence[Loss]:
        """The losses of the newest training that the run's history has so far."""
        return self._past.losses()

    def policy_losses(self) -> Sequence[tuple[int, int, float]]:
        """Version, epoch and loss of each policy, the oldest first."""
        files = sorted((self.folder / "policies").glob("*.safetensors"))[-POLICIES_SHOWN:]
        known, self._losses = self._losses, {}
        for path in files:
            self._losses[path] = known[path] if path in known else _loss_of(path)
        return [told for told in self._losses.values() if told is not None]

    def logs(self) -> Mapping[str, Sequence[str]]:
        """The last lines that each process printed, by the name of its log."""
        files = sorted((self.folder / "logs").glob("*.log"))[:LOGS_SHOWN]
        return {file.stem: _last_lines(file) for file in files if file.stem != "supervisord"}

    def endings(self) -> Mapping[str, str]:
        """How the processes ended that were not started since, by the name of their logs."""
        endings: dict[str, str] = {}
        lines = _last_lines(self.folder / "logs" / "supervisord.log", 2000)
        for line in lines:
            if found := re.search(r"(?:INFO|WARN) (exited|stopped): (\S+) \((.*)\)$", line):
                endings[found[2].rpartition(":")[2]] = f"{found[1]}: {found[3]}"
            elif found := re.search(r"INFO spawned: '([^']+)'", line):
                endings.pop(found[1].rpartition(":")[2], None)
        return endings

    def _add(self, path: Path, heading: EpisodeHeading) -> None:
        with self._lock:
            self._found += 1
            if len(self._recordings) == RECORDINGS_KEPT:
                self._paths.pop(self._recordings[0].heading.id, None)
            self._recordings.append(Recording(self._found, path, heading))
            self._paths[heading.id] = path


def _written_at_ns(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:  # it has just been deleted
        return 0


def _loss_of(policy: Path) -> tuple[int, int, float] | None:
    """Version, epoch and loss of a policy; None if the file does not say."""
    try:
        told = load_checkpoint(policy).metadata
    except UserError:
        return None
    return None if told.loss is None else (told.version, told.epoch, told.loss)


def _last_lines(file: Path, most: int = LINES_SHOWN) -> list[str]:
    """The last lines of a log as texts that can be shown; none if it cannot be read."""
    try:
        with file.open("rb") as stream:
            size = stream.seek(0, os.SEEK_END)
            start = stream.seek(max(0, size - _TAIL_BYTES))
            lines = stream.read(_TAIL_BYTES).decode(errors="replace").splitlines()
    except OSError:
        return []
    whole = lines if start == 0 else lines[1:]
    return [plain(line, LINE_LETTERS) for line in whole[-most:]]
