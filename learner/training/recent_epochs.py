"""The epochs of a training that were not told of yet."""

from __future__ import annotations

from collections import deque

from learner.training.trainer import Trainer
from proto.messages import LARGEST_LOSS
from proto.metrics import LARGEST_LEARNING_RATE, MOST_EPOCHS, EpochMetrics, Stage


class RecentEpochs:
    """Collects epochs in one thread, and gives them to another.

    Attributes:
        learning_rate: learning rate of the last epoch; None before the first.
    """

    def __init__(self) -> None:
        self.learning_rate: float | None = None
        self._waiting: deque[EpochMetrics] = deque(maxlen=MOST_EPOCHS)

    def note(self, trainer: Trainer) -> None:
        """Note the epoch that a trainer has just done."""
        self.learning_rate = min(trainer.learning_rate or 0.0, LARGEST_LEARNING_RATE)
        pretraining = trainer.stage is Stage.PRETRAINING
        self._waiting.append(
            EpochMetrics(
                stage=Stage.PRETRAINING if pretraining else Stage.COUPLED,
                epoch=trainer.epochs_done,
                loss=min(trainer.loss or 0.0, LARGEST_LOSS),
                learning_rate=self.learning_rate,
            )
        )

    def taken(self) -> tuple[EpochMetrics, ...]:
        """The epochs since the last call, oldest first; at most the newest MOST_EPOCHS."""
        taken = []
        while self._waiting:
            taken.append(self._waiting.popleft())
        return tuple(taken)
