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
from services.monitoring.history_files import HistoryFiles
from services.monitoring.sample import LearnerSample, Sample

LOG = logging.getLogger(__name__)

PERIOD_S: Final = 0.25
"""Least time between two samples at first."""


class TrainingMonitor:
    """Writes `metrics.jsonl` and an event file into the folder of a training."""

    def __init__(self, trainer: Trainer, folder: Path) -> None:
        self._trainer = trainer
        self._folder = folder
        self._files = HistoryFiles(folder, "train", period_s=PERIOD_S)
        self._version = trainer.version
        self._pace = Pace()
        self._epochs = RecentEpochs()

    def note_epoch(self) -> None:
        """Note that an epoch is done."""
        self._pace.add()
        self._epochs.note(self._trainer)
        now_s = time.time()
        stage_ends = self._trainer.epochs_done >= self._trainer.epochs_total
        if self._files.history.is_due(now_s) or stage_ends:
            sample = self._sample(now_s)
            self._files.history.add(sample)
            self._files.curves.add(sample, {})
        self._note_policies(now_s)
        self._files.flush_if_due()

    def end(self) -> None:
        """Note the last policy, and write what is left to disk."""
        self._note_policies(time.time())
        self._files.flush()

    def _note_policies(self, now_s: float) -> None:
        while self._version < self._trainer.version:
            self._version += 1
            try:
                policy = load_checkpoint(policy_file(self._folder, self._version))
            except UserError as error:
                LOG.warning("policy %d is not shown: %s", self._version, error)
                continue
            weights = policy.part(NETWORK_PREFIX)
            self._files.curves.add_weights(weights, version=self._version, time_s=now_s)

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
