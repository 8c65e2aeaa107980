"""A step of Adam on the CPU: one call of C++ for all parameters. See `adam.cpp`."""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import torch
from torch import Tensor

from learner.kernels.library import learning_library


def serves(weights: Tensor) -> bool:
    """Whether the kernel can compute on these weights, where and of what type they are."""
    return weights.device.type == "cpu" and weights.dtype in _functions()


def step(
    weights: Tensor,
    gradient: Tensor,
    means: Tensor,
    squares: Tensor,
    *,
    steps: int,
    rate: float,
    longest: float,
) -> None:
    """`learner.training.adam.reference_step`, computed by the kernel."""
    _functions()[weights.dtype](
        len(weights),
        *(array.data_ptr() for array in (weights, gradient, means, squares)),
        steps,
        rate,
        longest,
    )


@functools.cache
def _functions() -> dict[torch.dtype, Any]:
    """The kernel by type, none where it cannot be compiled."""
    library = learning_library()
    if library is None:
        return {}
    functions = {torch.float32: library.vmdnn_adam_float, torch.float64: library.vmdnn_adam_double}
    for function in functions.values():
        function.restype = None
        function.argtypes = (
            ctypes.c_int64,
            *[ctypes.c_void_p] * 4,
            ctypes.c_int64,
            ctypes.c_double,
            ctypes.c_double,
        )
    return functions
