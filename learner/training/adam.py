"""Adam (Kingma and Ba 2015), after a long gradient has been shortened.

There is one definition, in PyTorch, and a kernel that computes the same in one pass.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import torch
from torch import Tensor, nn

from learner.kernels import adam as kernel

_MEAN_DECAY: Final = 0.9
_SQUARE_DECAY: Final = 0.999
_EPSILON: Final = 1e-8


class Adam:
    """Changes parameters by their gradients.

    Weights and gradients become parts of two flat arrays, where the parameters and their `grad`
    show them as before. Gradients are added to `grad`, as `backward` does it; `grad` must not be
    replaced. It is zero at the beginning and after every step.
    """

    def __init__(self, parameters: Sequence[nn.Parameter], longest: float | None = None) -> None:
        """Begin as if all earlier gradients had been zero.

        Args:
            parameters: what is changed; all on one device and of one type.
            longest: norm to which a longer gradient, of all parameters together, is shortened.
        """
        self._longest = math.inf if longest is None else longest
        self._steps = 0
        self._shapes = [parameter.shape for parameter in parameters]
        self._weights = torch.cat([parameter.detach().flatten() for parameter in parameters])
        self._gradient = torch.zeros_like(self._weights)
        self._means = torch.zeros_like(self._weights)
        self._squares = torch.zeros_like(self._weights)
        parts = zip(
            parameters, self._parts(self._weights), self._parts(self._gradient), strict=True
        )
        for parameter, weights, gradient in parts:
            parameter.data = weights
            parameter.grad = gradient

    def step(self, rate: float) -> None:
        """Change the parameters, at this rate, by the gradient, which is zero afterwards."""
        self._steps += 1
        do_step = kernel.step if kernel.serves(self._weights) else reference_step
        do_step(
            self._weights,
            self._gradient,
            self._means,
            self._squares,
            steps=self._steps,
            rate=rate,
            longest=self._longest,
        )

    def tensors(self) -> dict[str, Tensor]:
        """The state, by index of the parameter and name, which are those of PyTorch's Adam."""
        tensors = {}
        for index, memory in enumerate(zip(*self._memory(), strict=True)):
            tensors[f"{index}.step"] = torch.tensor(float(self._steps))
            tensors[f"{index}.exp_avg"], tensors[f"{index}.exp_avg_sq"] = memory
        return tensors

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Take the state that `tensors` gave.

        Raises:
            KeyError: a part of it is missing.
        """
        for index, (mean, square) in enumerate(zip(*self._memory(), strict=True)):
            self._steps = int(tensors[f"{index}.step"])
            mean.copy_(tensors[f"{index}.exp_avg"])
            square.copy_(tensors[f"{index}.exp_avg_sq"])

    def _memory(self) -> tuple[list[Tensor], list[Tensor]]:
        """Means of the gradient and of its squares, by parameter."""
        return self._parts(self._means), self._parts(self._squares)

    def _parts(self, flat: Tensor) -> list[Tensor]:
        """What of a flat array belongs to each parameter, in its shape."""
        parts = torch.split(flat, [shape.numel() for shape in self._shapes])
        return [part.view(shape) for part, shape in zip(parts, self._shapes, strict=True)]


def reference_step(
    weights: Tensor,
    gradient: Tensor,
    means: Tensor,
    squares: Tensor,
    *,
    steps: int,
    rate: float,
    longest: float,
) -> None:
    """What a step means, in PyTorch.

    Args:
        weights: (N,) changed.
        gradient: (N,) by the weights; zero afterwards.
        means: (N,) of the gradient, changed.
        squares: (N,) means of its squares, changed.
        steps: number of this step, from 1 on.
        rate: learning rate.
        longest: norm to which a longer gradient is shortened; may be infinite.
    """
    gradient *= min(1.0, longest / (gradient.norm().item() + 1e-6))
    means.lerp_(gradient, 1 - _MEAN_DECAY)
    squares.mul_(_SQUARE_DECAY).addcmul_(gradient, gradient, value=1 - _SQUARE_DECAY)
    spread = (squares / (1 - _SQUARE_DECAY**steps)).sqrt_().add_(_EPSILON)
    weights.addcdiv_(means, spread, value=-rate / (1 - _MEAN_DECAY**steps))
    gradient.zero_()
