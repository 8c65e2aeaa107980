"""Keeps the history of a training without the bus, and what TensorBoard shows of it."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from learner.checkpoint import NETWORK_PREFIX, load_checkpoint, policy_file
from learner.training.recent_epochs import RecentEpochs
from learner.training.trainer import Trainer
from proto.errors import UserError
from proto.pace import Pace
from proto.storage import StorageError
from services.monitoring.curves import Curves
from services.monitoring.event_file import EventFile
from services.monitoring.history import History, history_file
from services.monitoring.sample import LearnerSample, Sample

LOG = logging.getLogger(__name__)

PERIOD_S: Final = 0.25
"""Least time between two samples at first."""
FLUSH_S: Final = 10.0


class TrainingMonitor:
    """Writes `metrics.jsonl` and an event file into the folder of a training."""

    def __init__(self, trainer: Trainer, folder: Path) -> None:
        self._trainer = trainer
        self._folder = folder
        self._history = History(history_file(folder), period_s=PERIOD_S)
        self._events = EventFile(folder, "train")
        self._curves = Curves(self._events)
        self._version = trainer.version
        self._pace = Pace()
        self._epochs = RecentEpochs()
        self._flushed_s = time.monotonic()
        self._told = False

    def note_epoch(self) -> None:
        """Note that an epoch is done."""
        self._pace.add()
        self._epochs.note(self._trainer)
        now_s = time.time()
        stage_ends = self._trainer.epochs_done >= self._trainer.epochs_total
        if self._history.is_due(now_s) or stage_ends:
            sample = self._sample(now_s)
            self._history.add(sample)
            self._curves.add(sample, {})
        self._note_policies(now_s)
        if time.monotonic() - self._flushed_s >= FLUSH_S:
            self._flush()

    def end(self) -> None:
        """Note the last policy, and write what is left to disk."""
        self._note_policies(time.time())
        self._flush()

    def _note_policies(self, now_s: float) -> None:
        while self._version < self._trainer.version:
            self._version += 1
            try:
                policy = load_checkpoint(policy_file(self._folder, self._version))
            except UserError as error:
                LOG.warning("policy %d is not shown: %s", self._version, error)
                continue
            weights = policy.part(NETWORK_PREFIX)
            self._curves.add_weights(weights, version=self._version, time_s=now_s)

    def _flush(self) -> None:
        """Write to disk. A disk that does not allow it is told of once; training goes on."""
        self._flushed_s = time.monotonic()
        try:
            self._history.flush()
            self._events.flush()
        except StorageError as error:
            if not self._told:
                LOG.warning("the history waits: %s", error)
            self._told = True

    def _sample(self, now_s: float) -> Sample:
        trainer = self._trainer
        learner = LearnerSample(
            training="",
            stage=trainer.stage,
            round=0,
            epochs=self._epochs.taken(),
            epochs_per_s=self._pace.per_second(),
            sequences=trainer.sequences,
            policy_version=trainer.version,
        )
        return Sample(time_s=now_s, learner=learner)


@contextmanager
def monitored(trainer: Trainer, folder: Path) -> Iterator[TrainingMonitor]:
    """Monitor a training; call `note_epoch` after each epoch. At the end all is on disk.

    Args:
        trainer: the training.
        folder: folder of its run.

    Raises:
        StorageError: an earlier history in the folder cannot be repaired.
    """
    monitor = TrainingMonitor(trainer, folder)
    try:
        yield monitor
    finally:
        monitor.end()
