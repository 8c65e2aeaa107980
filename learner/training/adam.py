"""Adam (Kingma and Ba 2015) with clipping of the gradient's norm.

`reference_step` defines a step in PyTorch. `learner.kernels.adam` computes it in one pass.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import torch
from torch import Tensor, nn

from learner.kernels import adam as kernel
from learner.kernels.adam import AdamArrays

_MEAN_DECAY: Final = 0.9
_SQUARE_DECAY: Final = 0.999
_EPSILON: Final = 1e-8


class Adam:
    """Optimizer of parameters.

    Weights and gradients are moved into two flat arrays; the parameters and their `grad` become
    views of these. Add gradients to `grad`, as `backward` does, and do not replace `grad`. It is
    zero at the beginning and after every step.
    """

    def __init__(self, parameters: Sequence[nn.Parameter], max_norm: float | None = None) -> None:
        """Start with running means of zero.

        Args:
            parameters: what is optimized; all on one device and of one type.
            max_norm: a gradient of all parameters together with a larger norm is scaled down to
                it; None for no limit.
        """
        self._max_norm = math.inf if max_norm is None else max_norm
        self._steps = 0
        self._shapes = [parameter.shape for parameter in parameters]
        weights = torch.cat([parameter.detach().flatten() for parameter in parameters])
        self._arrays = AdamArrays(weights, *(torch.zeros_like(weights) for _ in range(3)))
        views = zip(
            parameters,
            self._views(self._arrays.weights),
            self._views(self._arrays.gradient),
            strict=True,
        )
        for parameter, weight, gradient in views:
            parameter.data = weight
            parameter.grad = gradient

    def step(self, rate: float) -> None:
        """Change the parameters by their gradients, which are zero afterwards.

        Args:
            rate: learning rate.
        """
        self._steps += 1
        do_step = kernel.step if kernel.supports(self._arrays.weights) else reference_step
        do_step(self._arrays, number=self._steps, rate=rate, max_norm=self._max_norm)

    def tensors(self) -> dict[str, Tensor]:
        """The state, named `INDEX.NAME` as PyTorch's Adam names it; INDEX is the parameter's."""
        tensors = {}
        for index, means in enumerate(zip(*self._means(), strict=True)):
            tensors[f"{index}.step"] = torch.tensor(float(self._steps))
            tensors[f"{index}.exp_avg"], tensors[f"{index}.exp_avg_sq"] = means
        return tensors

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the state from what `tensors` returned.

        Raises:
            KeyError: a tensor is missing.
        """
        for index, (mean, square) in enumerate(zip(*self._means(), strict=True)):
            self._steps = int(tensors[f"{index}.step"])
            mean.copy_(tensors[f"{index}.exp_avg"])
            square.copy_(tensors[f"{index}.exp_avg_sq"])

    def _means(self) -> tuple[list[Tensor], list[Tensor]]:
        """Running means of the gradient and of its squares, for each parameter."""
        return self._views(self._arrays.means), self._views(self._arrays.squares)

    def _views(self, flat: Tensor) -> list[Tensor]:
        """The part of a flat array that belongs to each parameter, in the parameter's shape."""
        parts = torch.split(flat, [shape.numel() for shape in self._shapes])
        return [part.view(shape) for part, shape in zip(parts, self._shapes, strict=True)]


def reference_step(arrays: AdamArrays, *, number: int, rate: float, max_norm: float) -> None:
    """A step in PyTorch; it defines what the compiled kernel computes.

    Args:
        arrays: changed in place.
        number: number of the step, from 1 on.
        rate: learning rate.
        max_norm: a gradient with a larger norm is scaled down to it; may be infinite.
    """
    gradient, means, squares = arrays.gradient, arrays.means, arrays.squares
    gradient *= min(1.0, max_norm / (gradient.norm().item() + 1e-6))
    means.lerp_(gradient, 1 - _MEAN_DECAY)
    squares.mul_(_SQUARE_DECAY).addcmul_(gradient, gradient, value=1 - _SQUARE_DECAY)
    spread = (squares / (1 - _SQUARE_DECAY**number)).sqrt_().add_(_EPSILON)
    arrays.weights.addcdiv_(means, spread, value=-rate / (1 - _MEAN_DECAY**number))
    gradient.zero_()
