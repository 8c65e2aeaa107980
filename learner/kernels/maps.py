"""A subnet of feature maps (V_F, V_S) on the CPU: one call of C++ for whole sequences.

`maps.cpp` says how it is computed.
"""

from __future__ import annotations

import ctypes
import math
from typing import Any, Final, cast

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx

from learner.kernels.typed import TypedKernel

_COUNTS: Final = (
    *("sequences", "steps", "threads", "maps_below", "height_below", "width_below"),
    *("maps", "kernel_height", "kernel_width", "stride"),
)
_ARRAYS: Final = (
    *("below", "kernel", "bias", "activity"),
    *("by_activity", "by_drive", "by_kernel", "by_bias", "by_below"),
)


class _Problem(ctypes.Structure):
    """`MapsProblem` of maps.cpp, where its members are described."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in _COUNTS),
        ("leak", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
    )


_KERNEL: Final = TypedKernel("vmdnn_maps", (ctypes.POINTER(_Problem),), ctypes.c_int)

supports = _KERNEL.supports


def maps(below: Tensor, kernel: Tensor, bias: Tensor, stride: int, tau: float) -> Tensor:
    """Activity of a subnet, as `learner.network.mstnn.Maps` defines it; differentiable once.

    Args:
        below: (B, T, maps below, height, width).
        kernel: (maps, maps below, height, width).
        bias: (maps,).
        stride: shift of the kernel between neighbouring units.
        tau: time constant in control steps.

    Returns:
        (B, T, maps, rows, columns).

    Raises:
        ValueError: shapes or types do not fit together.
        MemoryError: there is not enough memory.
    """
    if below.dim() != 5 or below.shape[2] != kernel.shape[1]:
        raise ValueError(f"below is {tuple(below.shape)}, but the kernel {tuple(kernel.shape)}")
    if len(bias) != len(kernel):
        raise ValueError(f"there are {len(bias)} biases for {len(kernel)} maps")
    rows, columns = (
        size - taps for size, taps in zip(below.shape[3:], kernel.shape[2:], strict=True)
    )
    if stride < 1 or min(rows, columns) < 0 or not 1 <= tau < math.inf:
        raise ValueError(
            f"a kernel {tuple(kernel.shape)} with the stride {stride} and the time constant {tau}"
            f" does not fit below, which is {tuple(below.shape)}"
        )
    if not below.dtype == kernel.dtype == bias.dtype:
        raise ValueError(f"below is {below.dtype}, but the kernel {kernel.dtype}")
    result = _Maps.apply(below, kernel, bias, stride, tau)  # type: ignore[no-untyped-call]
    return cast("Tensor", result)


class _Maps(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: FunctionCtx, below: Tensor, kernel: Tensor, bias: Tensor, stride: int, tau: float
    ) -> Tensor:
        below, kernel, bias = below.contiguous(), kernel.contiguous(), bias.contiguous()
        sizes = (
            (size - taps) // stride + 1
            for size, taps in zip(below.shape[3:], kernel.shape[2:], strict=True)
        )
        activity = below.new_empty(*below.shape[:2], len(kernel), *sizes)
        _call(below, kernel, bias, activity, stride, tau)
        ctx.save_for_backward(below, kernel, bias, activity)
        ctx.stride, ctx.tau = stride, tau  # type: ignore[attr-defined]
        return activity

    @staticmethod
    def backward(ctx: Any, *by_outputs: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError(
                "the compiled feature maps give first derivatives only, so create_graph=True does"
                " not work on them"
            )
        below, kernel, bias, activity = ctx.saved_tensors
        gradients = {
            "by_activity": by_outputs[0].contiguous(),
            "by_drive": torch.empty_like(activity),
            "by_kernel": torch.empty_like(kernel),
            "by_bias": torch.empty_like(bias),
        }
        if ctx.needs_input_grad[0]:
            gradients["by_below"] = torch.empty_like(below)
        _call(below, kernel, bias, activity, ctx.stride, ctx.tau, **gradients)
        by_inputs = (gradients.get(f"by_{name}") for name in ("below", "kernel", "bias"))
        return (*by_inputs, None, None)


def _call(
    below: Tensor,
    kernel: Tensor,
    bias: Tensor,
    activity: Tensor,
    stride: int,
    tau: float,
    **gradients: Tensor,
) -> None:
    arrays = {"below": below, "kernel": kernel, "bias": bias, "activity": activity, **gradients}
    sequences, steps, maps_below, height_below, width_below = below.shape
    problem = _Problem(
        sequences=sequences,
        steps=steps,
        threads=torch.get_num_threads(),
        maps_below=maps_below,
        height_below=height_below,
        width_below=width_below,
        maps=len(kernel),
        kernel_height=kernel.shape[2],
        kernel_width=kernel.shape[3],
        stride=stride,
        leak=1 / tau,
        **{name: array.data_ptr() for name, array in arrays.items()},
    )
    if _KERNEL(below.dtype, ctypes.byref(problem)) != 0:
        raise MemoryError(f"there is no memory for the maps of {sequences} sequences")
