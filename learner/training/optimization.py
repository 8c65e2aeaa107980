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


class Lesson(Protocol):
    """Sequences and what is to be learned from them."""

    parameters: list[nn.Parameter]

    def __len__(self) -> int:
        """Number of sequences."""

    def add(self, episode: Episode) -> None:
        """Take a sequence in."""

    def add_gradients(self, chosen: Tensor) -> float:
        """Mean loss of the sequences with these indices.

        Its gradients are added to the parameters' `grad`, as `backward` adds them.
        """


@dataclass(frozen=True)
class Plan:
    """How a lesson is learned.

    Attributes:
        epochs: how often every sequence is shown.
        rate: learning rate of Adam.
        schedule: whether the rate stays, or falls to zero as half a cosine.
        warmup_epochs: epochs in which the rate first rises to its full value.
        batch: sequences in a minibatch, at most.
        clip_norm: largest norm of the gradient, or None.
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
    """Learns a lesson, epoch by epoch."""

    def __init__(self, lesson: Lesson, plan: Plan) -> None:
        self._lesson = lesson
        self._plan = plan
        self._adam = Adam(lesson.parameters, plan.clip_norm)

    def epoch(self, number: int, generator: torch.Generator) -> float:
        """Show every sequence once, in minibatches of nearly equal size; the mean loss.

        Raises:
            UserError: the training diverged.
        """
        rate = self._plan.rate_at(number)
        minibatches = self._minibatches(generator)
        total = sum(self._update(chosen, rate) * len(chosen) for chosen in minibatches)
        return total / len(self._lesson)

    def tensors(self) -> dict[str, Tensor]:
        """The state of Adam, by parameter and name."""
        return self._adam.tensors()

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Take the state that `tensors` gave.

        Raises:
            KeyError: a part of it is missing.
        """
        self._adam.load_tensors(tensors)

    def _minibatches(self, generator: torch.Generator) -> Iterator[Tensor]:
        count = len(self._lesson)
        shuffled = torch.randperm(count, generator=generator)
        return iter(shuffled.tensor_split(math.ceil(count / self._plan.batch)))

    def _update(self, chosen: Tensor, rate: float) -> float:
        loss = self._lesson.add_gradients(chosen)
        if not math.isfinite(loss):
            raise UserError(
                f"the training diverged (loss {loss}): lower learner.rate or learner.clip_norm,"
                " and go on from the last checkpoint or start again"
            )
        self._adam.step(rate)
        return loss
