"""How coupled training is divided: a first lap, then one for each round of corrections."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Laps:
    """Epochs of the laps; each is a training with an optimizer and a schedule of its own.

    Attributes:
        first: epochs of the first lap.
        rounds: number of laps that follow, one for each round of corrections.
        each: epochs of each of those.
    """

    first: int
    rounds: int
    each: int

    @property
    def total(self) -> int:
        """Epochs of all laps."""
        return self.end_of(self.rounds)

    def round_at(self, epoch: int) -> int:
        """Round, from 1, of the lap that an epoch, from 0, lies in; 0 in the first lap."""
        return 0 if epoch < self.first else min((epoch - self.first) // self.each + 1, self.rounds)

    def length_of(self, number: int) -> int:
        """Epochs of a round's lap."""
        return self.each if number else self.first

    def start_of(self, number: int) -> int:
        """First epoch of a round's lap."""
        return self.end_of(number) - self.length_of(number)

    def end_of(self, number: int) -> int:
        """Epochs that are done when a round's lap is over."""
        return self.first + number * self.each
