"""The history of a run and its event file, written to disk together."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Final

from proto.storage import StorageError
from services.monitoring.curves import Curves
from services.monitoring.event_file import EventFile
from services.monitoring.history import History, history_file

LOG = logging.getLogger(__name__)

FLUSH_S: Final = 10.0
"""What is kept is written to disk so often; a killed process loses no more."""


class HistoryFiles:
    """What is kept in the folder of a run. Used by one thread.

    Attributes:
        history: the samples.
        events: the event file, for what is not a curve.
        curves: the curves of the event file.
    """

    def __init__(self, folder: Path, writer: str, *, period_s: float) -> None:
        """Open the files.

        Args:
            folder: folder of the run.
            writer: name of the process, valid in a file's name.
            period_s: least time between two samples at first (s).

        Raises:
            StorageError: an earlier history cannot be repaired.
        """
        self.history = History(history_file(folder), period_s=period_s)
        self.events = EventFile(folder, writer)
        self.curves = Curves(self.events)
        self._flushed_s = time.monotonic()
        self._waits = False

    def flush_if_due(self) -> None:
        """Write to disk, if the last time is long enough ago."""
        if time.monotonic() - self._flushed_s >= FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Write to disk. A disk that does not allow it is told of once, and tried again."""
        self._flushed_s = time.monotonic()
        try:
            self.history.flush()
            self.events.flush()
        except StorageError as error:
            if not self._waits:
                LOG.warning("the history waits: %s", error)
            self._waits = True
        else:
            if self._waits:
                LOG.info("the history is written again")
            self._waits = False
