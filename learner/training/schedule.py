"""How coupled training is divided into rounds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RoundSchedule:
    """Epochs of the rounds; each round has an optimizer and a learning rate schedule of its own.

    Round 0 is coupled training before any corrections. Rounds 1, 2, ... follow one round of
    corrections each.

    Attributes:
        initial_epochs: epochs of round 0.
        rounds: number of rounds of corrections.
        epochs_per_round: epochs of each later round.
    """

    initial_epochs: int
    rounds: int
    epochs_per_round: int

    @property
    def total(self) -> int:
        """Epochs of all rounds."""
        return self.end_of(self.rounds)

    def round_at(self, epoch: int) -> int:
        """Round that an epoch, counted from 0, belongs to; later epochs belong to the last one."""
        if epoch < self.initial_epochs:
            return 0
        return min((epoch - self.initial_epochs) // self.epochs_per_round + 1, self.rounds)

    def epochs_of(self, number: int) -> int:
        """Epochs of a round."""
        return self.epochs_per_round if number else self.initial_epochs

    def start_of(self, number: int) -> int:
        """First epoch of a round, counted from 0."""
        return self.end_of(number) - self.epochs_of(number)

    def end_of(self, number: int) -> int:
        """Epochs done at the end of a round."""
        return self.initial_epochs + number * self.epochs_per_round
