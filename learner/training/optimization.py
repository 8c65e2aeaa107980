"""Gradient descent on sequences: minibatches, learning rate, clipping, Adam."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor, nn

from learner.training.adam import Adam
from proto.episode import Episode
from proto.errors import UserError


class Objective(Protocol):
    """Sequences, and the loss of a network on them.

    Attributes:
        parameters: what is trained.
    """

    parameters: list[nn.Parameter]

    def __len__(self) -> int:
        """Number of sequences."""

    def add(self, episode: Episode) -> None:
        """Add a sequence."""

    def add_gradients(self, chosen: Tensor) -> float:
        """Mean loss of some sequences; adds its gradients to the parameters' `grad`.

        Args:
            chosen: (B,) int64 indices of the sequences.
        """


@dataclass(frozen=True)
class Hyperparameters:
    """Settings of one optimization.

    Attributes:
        epochs: how often every sequence is shown.
        rate: learning rate of Adam.
        schedule: the rate stays constant, or falls to zero as half a cosine.
        warmup_epochs: epochs in which the rate first rises to its full value.
        batch: most sequences in a minibatch.
        clip_norm: largest norm of the gradient, or None for no limit.
    """

    epochs: int
    rate: float
    schedule: Literal["constant", "cosine"]
    warmup_epochs: int
    batch: int
    clip_norm: float | None

    def rate_at(self, epoch: int) -> float:
        """Learning rate of an epoch, counted from 0."""
        rising = min(1.0, (epoch + 1) / max(self.warmup_epochs, 1))
        falling = (1 + math.cos(math.pi * epoch / self.epochs)) / 2
        return self.rate * rising * (falling if self.schedule == "cosine" else 1.0)


class Optimization:
    """Minimizes an objective, epoch by epoch."""

    def __init__(self, objective: Objective, hyperparameters: Hyperparameters) -> None:
        self._objective = objective
        self._hyperparameters = hyperparameters
        self._adam = Adam(objective.parameters, hyperparameters.clip_norm)

    def epoch(self, number: int, generator: torch.Generator) -> float:
        """Show every sequence once, in minibatches of nearly equal size; the mean loss.

        Args:
            number: number of the epoch, from 0 on; sets the learning rate.
            generator: draws the order of the sequences.

        Raises:
            UserError: the training diverged.
        """
        rate = self.rate_at(number)
        minibatches = self._minibatches(generator)
        total = sum(self._update(chosen, rate) * len(chosen) for chosen in minibatches)
        return total / len(self._objective)

    def rate_at(self, number: int) -> float:
        """Learning rate of an epoch, counted from 0."""
        return self._hyperparameters.rate_at(number)

    def tensors(self) -> dict[str, Tensor]:
        """The state of the optimizer by name; see `Adam.tensors`."""
        return self._adam.tensors()

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the state from what `tensors` returned.

        Raises:
            KeyError: a tensor is missing.
        """
        self._adam.load_tensors(tensors)

    def _minibatches(self, generator: torch.Generator) -> Iterator[Tensor]:
        count = len(self._objective)
        shuffled = torch.randperm(count, generator=generator)
        return iter(shuffled.tensor_split(math.ceil(count / self._hyperparameters.batch)))

    def _update(self, chosen: Tensor, rate: float) -> float:
        loss = self._objective.add_gradients(chosen)
        if not math.isfinite(loss):
            raise UserError(
                f"the training diverged (loss {loss}): lower learner.rate or learner.clip_norm,"
                " and go on from the last checkpoint or start again"
            )
        self._adam.step(rate)
        return loss
