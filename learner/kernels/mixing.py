"""Weighted sums of sequences on the CPU: one call of C++ for a whole minibatch (`mixing.cpp`)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.kernels.typed import TypedKernel

_COUNTS: Final = ("mixtures", "parts", "steps", "inputs", "values", "softmax_units")
_ARRAYS: Final = (
    *("members", "weights", "target_weights", "seen", "targets"),
    *("minima", "maxima", "references", "widths"),
    *("mixed_seen", "codes", "code_entropies"),
)


class _Problem(ctypes.Structure):
    """`MixingProblem` of mixing.cpp, where its members are described."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in _COUNTS),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
    )


_KERNEL: Final = TypedKernel("vmdnn_mix", (ctypes.POINTER(_Problem),))

supports = _KERNEL.supports


class SoftmaxArrays(Protocol):
    """The arrays of a softmax code of action values, as `learner.network.softmax_code` has them."""

    @property
    def minima(self) -> NDArray[np.float64]:
        """(values,) lowest value of each range."""

    @property
    def maxima(self) -> NDArray[np.float64]:
        """(values,) highest value of each range."""

    @property
    def references(self) -> NDArray[np.float64]:
        """(values, softmax units) the value that each unit stands for."""

    @property
    def widths(self) -> NDArray[np.float64]:
        """(values,) standard deviation of the excitation."""


@dataclass(frozen=True)
class MixedArrays:
    """B mixtures of sequences.

    Attributes:
        seen: (B, T, inputs) mixed activity of V_S.
        codes: (B, T, values, softmax units) the mixed targets in code.
        code_entropies: (B, T) sum of codes * log(codes).
    """

    seen: Tensor
    codes: Tensor
    code_entropies: Tensor


def mix(
    members: Tensor,
    weights: Tensor,
    target_weights: Tensor,
    seen: Tensor,
    targets: Tensor,
    code: SoftmaxArrays,
) -> MixedArrays:
    """Mix sequences and code the mixed targets.

    Args:
        members: (B, parts) int64 indices of sequences.
        weights: (B, parts) weight of each part in V_S; what has none is not read.
        target_weights: (B, parts) weight of each part in the actions.
        seen: (S, T, inputs) activity of V_S; its type is that of the results.
        targets: (S, T, values) actions.
        code: how actions are coded.

    Raises:
        ValueError: the sizes do not fit together.
        IndexError: an index in `members` is outside 0..S - 1.
    """
    _check(members, (weights, target_weights), seen, targets, code)
    count, parts = members.shape
    _, steps, inputs = seen.shape
    values, softmax_units = code.references.shape
    mixed = MixedArrays(
        seen=seen.new_empty(count, steps, inputs),
        codes=seen.new_empty(count, steps, values, softmax_units),
        code_entropies=seen.new_empty(count, steps),
    )
    # named, so that these arrays live until the kernel has read them
    arrays = [
        members.contiguous(),
        *(_like(seen, each) for each in (weights, target_weights, seen, targets)),
        *(
            _like(seen, torch.from_numpy(each))
            for each in (code.minima, code.maxima, code.references, code.widths)
        ),
        mixed.seen,
        mixed.codes,
        mixed.code_entropies,
    ]
    problem = _Problem(
        *(count, parts, steps, inputs, values, softmax_units),
        *(array.data_ptr() for array in arrays),
    )
    _KERNEL(seen.dtype, ctypes.byref(problem))
    return mixed


def _like(seen: Tensor, values: Tensor) -> Tensor:
    return values.to(seen.dtype).contiguous()


def _check(
    members: Tensor,
    all_weights: Sequence[Tensor],
    seen: Tensor,
    targets: Tensor,
    code: SoftmaxArrays,
) -> None:
    """The kernel follows sizes and indices without checking them."""
    values = len(code.references)
    if members.dtype != torch.int64 or members.dim() != 2 or members.numel() == 0:
        raise ValueError(
            f"members are {tuple(members.shape)} {members.dtype}, not (B, parts) int64"
        )
    for weights in all_weights:
        if weights.shape != members.shape:
            raise ValueError(f"weights are {tuple(weights.shape)}, not {tuple(members.shape)}")
    if targets.shape != (*seen.shape[:2], values):
        raise ValueError(
            f"targets are {tuple(targets.shape)}, but seen is {tuple(seen.shape)} and the code has"
            f" {values} values"
        )
    lowest, highest = (int(each) for each in torch.aminmax(members))
    if not 0 <= lowest <= highest < len(seen):
        raise IndexError(f"members go from {lowest} to {highest}, but there are {len(seen)}")
