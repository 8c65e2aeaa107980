"""A step of Adam on the CPU: one call of C++ for all parameters (`adam.cpp`)."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Final

from torch import Tensor

from learner.kernels.typed import TypedKernel

_KERNEL: Final = TypedKernel(
    "vmdnn_adam",
    (
        ctypes.c_int64,
        *[ctypes.c_void_p] * 4,
        ctypes.c_int64,
        ctypes.c_double,
        ctypes.c_double,
    ),
)

supports = _KERNEL.supports


@dataclass(frozen=True)
class AdamArrays:
    """What a step of Adam changes; all contiguous, on one device and of one type.

    Attributes:
        weights: (N,).
        gradient: (N,) by the weights; zero after the step.
        means: (N,) running means of the gradient.
        squares: (N,) running means of its squares.
    """

    weights: Tensor
    gradient: Tensor
    means: Tensor
    squares: Tensor


def step(arrays: AdamArrays, *, number: int, rate: float, max_norm: float) -> None:
    """Do a step of Adam, as `learner.training.adam.reference_step` defines it.

    Args:
        arrays: changed in place; `supports(arrays.weights)` must hold.
        number: number of the step, from 1 on.
        rate: learning rate.
        max_norm: a gradient with a larger norm is scaled down to it; may be infinite.

    Raises:
        ValueError: the arrays differ in size or type, or one is not contiguous.
    """
    weights = arrays.weights
    for array in vars(arrays).values():  # the kernel follows the size without checking it
        fits = array.shape == weights.shape and array.dtype == weights.dtype
        if not fits or array.dim() != 1 or not array.is_contiguous():
            raise ValueError(f"an array of Adam is {tuple(array.shape)} {array.dtype}")
    _KERNEL(
        weights.dtype,
        len(weights),
        *(array.data_ptr() for array in vars(arrays).values()),
        number,
        rate,
        max_norm,
    )
