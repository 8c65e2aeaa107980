"""Gradient descent on sequences: minibatches, learning rate, clipping, Adam."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final, Literal, Protocol

import torch
from torch import Tensor, nn

from proto.episode import Episode
from proto.errors import UserError

_ADAM_STATE: Final = ("step", "exp_avg", "exp_avg_sq")


class Lesson(Protocol):
    """Sequences and what is to be learned from them."""

    parameters: list[nn.Parameter]

    def __len__(self) -> int:
        """Number of sequences."""

    def add(self, episode: Episode) -> None:
        """Take a sequence in."""

    def loss(self, chosen: Tensor) -> Tensor:
        """Mean loss of the sequences with these indices, differentiable by the parameters."""


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
        self._adam = torch.optim.Adam(lesson.parameters, plan.rate, fused=True)

    def epoch(self, number: int, generator: torch.Generator) -> float:
        """Show every sequence once, in minibatches of nearly equal size; the mean loss.

        Raises:
            UserError: the training diverged.
        """
        for group in self._adam.param_groups:
            group["lr"] = self._plan.rate_at(number)
        total = sum(self._update(chosen) * len(chosen) for chosen in self._minibatches(generator))
        return total / len(self._lesson)

    def tensors(self) -> dict[str, Tensor]:
        """The state of Adam, by parameter and name."""
        state = self._adam.state_dict()["state"]
        return {
            f"{index}.{name}": values[name]
            for index, values in state.items()
            for name in _ADAM_STATE
        }

    def load_tensors(self, tensors: dict[str, Tensor]) -> None:
        """Take the state that `tensors` gave.

        Raises:
            KeyError: a part of it is missing.
        """
        state = {
            index: {name: tensors[f"{index}.{name}"] for name in _ADAM_STATE}
            for index in range(len(self._lesson.parameters))
        }
        self._adam.load_state_dict({**self._adam.state_dict(), "state": state})

    def _minibatches(self, generator: torch.Generator) -> Iterator[Tensor]:
        count = len(self._lesson)
        shuffled = torch.randperm(count, generator=generator)
        return iter(shuffled.tensor_split(math.ceil(count / self._plan.batch)))

    def _update(self, chosen: Tensor) -> float:
        loss = self._lesson.loss(chosen)
        self._adam.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if self._plan.clip_norm is not None:
            nn.utils.clip_grad_norm_(self._lesson.parameters, self._plan.clip_norm)
        value = loss.item()
        if not math.isfinite(value):
            raise UserError(
                f"the training diverged (loss {value}): lower learner.rate or learner.clip_norm,"
                " and go on from the last checkpoint or start again"
            )
        with one_thread():
            self._adam.step()
        return value


@contextmanager
def one_thread() -> Iterator[None]:
    """Let PyTorch compute in one thread.

    A step of Adam on so few weights takes less time than threads take to meet; where others use the
    cores too, it is a thousand times as long.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
