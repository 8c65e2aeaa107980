"""The recurrent scan on a GPU: one launch for all steps of all sequences, forward or backward.

These stand in for the loops of `learner.mtrnn`; all else of the network is PyTorch there.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import logging
from collections.abc import Sequence
from itertools import accumulate
from typing import Any, Final

import torch
from torch import Tensor

MOST_UNITS: Final = 128
MOST_LEVELS: Final = 3
"""The weights of so many units fit into the registers of one multiprocessor."""

# One program has a multiprocessor for itself, all of its registers.
_LAUNCH: Final = {"num_warps": 16, "maxnreg": 128}
_log = logging.getLogger(__name__)


def serves(tensor: Tensor, immediate: Sequence[Tensor]) -> bool:
    """Whether the kernel can compute on (T, N, B), where it is and for so many units and levels."""
    fits = tensor.shape[1] <= MOST_UNITS and len(immediate) < MOST_LEVELS
    return tensor.is_cuda and fits and _kernels() is not None


def run(
    drive: Tensor, keep: Tensor, initial: Tensor, delayed: Tensor, immediate: Sequence[Tensor]
) -> Tensor:
    """Activities h (T, N, B): v[t] = keep v[t-1] + drive[t] + delayed h[t-1] + immediate h[t].

    h = tanh(v). Arguments as of `learner.mtrnn.recurrent_scan`; `initial` (N, B) is v before.
    """
    bounds = _bounds(drive.shape[1], immediate)
    blocks = list(zip(bounds[1:], immediate, strict=False))
    return _launch(_kernels().run, (_by_sequence(drive), initial.T), keep, delayed, blocks, bounds)


def run_back(
    by_hidden: Tensor, hidden: Tensor, keep: Tensor, delayed: Tensor, immediate: Sequence[Tensor]
) -> Tensor:
    """dE/dv (T, N, B) from dE/dh, for what `run` gave."""
    bounds = _bounds(hidden.shape[1], immediate)
    blocks = [(start, block.T) for start, block in zip(bounds, immediate, strict=False)]
    given = (_by_sequence(by_hidden), _by_sequence(hidden))
    return _launch(_kernels().run_back, given, keep, delayed.T, blocks, bounds)


def _launch(
    kernel: Any,
    given: Sequence[Tensor],
    keep: Tensor,
    delayed: Tensor,
    blocks: Sequence[tuple[int, Tensor]],
    bounds: Sequence[int],
) -> Tensor:
    """What a kernel makes (T, N, B) of arrays of which the first is (B, T, N).

    Args:
        kernel: of `learner.kernels.scan`.
        given: what it reads.
        keep: (N,).
        delayed: (N, N) weights of the step before, or after.
        blocks: weights within a step, each with its first row.
        bounds: where each level begins.
    """
    batch, steps, units = given[0].shape
    padded = _power_of_2(units)
    width = _power_of_2(max((block.shape[1] for _, block in blocks), default=1))
    second, third = (*bounds[1:], padded, padded)[:2]
    result = torch.empty_like(given[0])
    kernel[(batch,)](
        *(each.contiguous() for each in given),
        keep.contiguous(),
        _wide(keep, units, padded, [(0, delayed)]),
        _wide(keep, units, width, blocks),
        result,
        steps,
        units,
        LEVELS=len(bounds),
        SECOND=second,
        THIRD=third,
        PADDED=padded,
        WIDTH=width,
        **_LAUNCH,
    )
    return result.permute(1, 2, 0)


def _by_sequence(activity: Tensor) -> Tensor:
    """(T, N, B) as (B, T, N)."""
    return activity.permute(2, 0, 1).contiguous()


def _bounds(units: int, immediate: Sequence[Tensor]) -> list[int]:
    """Where each level begins."""
    later = list(accumulate((len(block) for block in reversed(immediate)), initial=0))
    return [0, *(units - end for end in reversed(later[1:]))]


def _wide(like: Tensor, rows: int, columns: int, blocks: Sequence[tuple[int, Tensor]]) -> Tensor:
    """Blocks in a matrix of zeros, each from a row on."""
    matrix = like.new_zeros(rows, columns)
    for start, block in blocks:
        matrix[start : start + block.shape[0], : block.shape[1]] = block
    return matrix


def _power_of_2(size: int) -> int:
    """The next one, and not less than 16."""
    return max(16, 1 << (size - 1).bit_length())


@functools.cache
def _kernels() -> Any:
    """The kernels, or None without Triton; says once which."""
    if importlib.util.find_spec("triton") is None:
        _log.warning("recurrent scan: in PyTorch, far slower on a GPU: Triton is not installed")
        return None
    _log.info("recurrent scan: Triton")
    return importlib.import_module("learner.kernels.scan")
