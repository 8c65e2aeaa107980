"""The losses of a run's training, read from its history as it grows."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from proto.codec import MEBIBYTE, MessageError
from proto.metrics import Stage
from services.board import Loss
from services.monitoring.sample import Sample

MOST_LOSSES: Final = 600
"""More losses are thinned out evenly."""
_READ_AT_ONCE: Final = 2 * MEBIBYTE
"""Bytes that one look reads: a history may be large when a viewer starts. A line has less."""
_TRAINED: Final = (Stage.PRETRAINING, Stage.COUPLED)


class PastLosses:
    """The losses of the newest training in a history that another process may write."""

    def __init__(self, path: Path) -> None:
        """Read nothing yet; see `look`."""
        self._path = path
        self._begin(file=0)

    def _begin(self, file: int) -> None:
        self._file = file
        self._read_to = 0
        self._training = ""
        self._losses: dict[Stage, dict[int, float]] = {stage: {} for stage in _TRAINED}
        self._thinned: Sequence[Loss] = ()

    def look(self) -> None:
        """Read what was added; each call reads a limited part. An unreadable file has nothing."""
        try:
            with self._path.open("rb") as stream:
                status = os.fstat(stream.fileno())
                if status.st_ino != self._file or status.st_size < self._read_to:
                    self._begin(status.st_ino)  # it was full, and samples were taken out
                stream.seek(self._read_to)
                content = stream.read(_READ_AT_ONCE)
        except OSError:
            return
        whole = content.rfind(b"\n") + 1  # the last line may not be finished
        if not whole:
            return
        self._read_to += whole
        for line in content[:whole].splitlines():
            self._add(line)
        self._thinned = self._thin()

    def losses(self) -> Sequence[Loss]:
        """The losses so far, in the order of the training; at most MOST_LOSSES."""
        return self._thinned

    def _add(self, line: bytes) -> None:
        try:
            learner = Sample.of_line(line).learner
        except MessageError:
            return
        if learner is None:
            return
        if learner.training != self._training:
            self._begin_training(learner.training)
        for epoch in learner.epochs:
            self._losses[epoch.stage][epoch.epoch] = epoch.loss

    def _begin_training(self, training: str) -> None:
        self._training = training
        for losses in self._losses.values():
            losses.clear()

    def _thin(self) -> Sequence[Loss]:
        found = [
            Loss(stage, epoch, losses[epoch])
            for stage, losses in self._losses.items()
            for epoch in sorted(losses)
        ]
        every = -(-len(found) // MOST_LOSSES)
        return found[::-every][::-1] if every > 1 else found  # the last one stays
