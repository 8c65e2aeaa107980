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
    steps, units, batch = drive.shape
    by_sequence = drive.permute(2, 0, 1).contiguous()
    hidden = torch.empty_like(by_sequence)
    bounds = _bounds(units, immediate)
    blocks = [(start, block) for start, block in zip(bounds[1:], immediate, strict=False)]
    padded = _power_of_2(units)
    _kernels().run[(batch,)](
        by_sequence,
        keep.contiguous(),
        initial.T.contiguous(),
        _wide(drive, units, padded, [(0, delayed)]),
        _wide(drive, units, _width(immediate, 1), blocks),
        hidden,
        steps,
        units,
        **_constants(bounds, padded, _width(immediate, 1)),
    )
    return hidden.permute(1, 2, 0)


def run_back(
    by_hidden: Tensor, hidden: Tensor, keep: Tensor, delayed: Tensor, immediate: Sequence[Tensor]
) -> Tensor:
    """dE/dv (T, N, B) from dE/dh, for what `run` gave."""
    steps, units, batch = hidden.shape
    by_sequence = by_hidden.permute(2, 0, 1).contiguous()
    deltas = torch.empty_like(by_sequence)
    bounds = _bounds(units, immediate)
    blocks = [(start, block.T) for start, block in zip(bounds, immediate, strict=False)]
    padded = _power_of_2(units)
    _kernels().run_back[(batch,)](
        by_sequence,
        hidden.permute(2, 0, 1).contiguous(),
        keep.contiguous(),
        _wide(hidden, units, padded, [(0, delayed.T)]),
        _wide(hidden, units, _width(immediate, 0), blocks),
        deltas,
        steps,
        units,
        **_constants(bounds, padded, _width(immediate, 0)),
    )
    return deltas.permute(1, 2, 0)


def _bounds(units: int, immediate: Sequence[Tensor]) -> list[int]:
    """Where each level begins."""
    later = list(accumulate((len(block) for block in reversed(immediate)), initial=0))
    return [0, *(units - end for end in reversed(later[1:]))]


def _width(immediate: Sequence[Tensor], side: int) -> int:
    """Columns that hold any block of weights, of which `side` are the columns."""
    return _power_of_2(max((block.shape[side] for block in immediate), default=1))


def _wide(like: Tensor, rows: int, columns: int, blocks: Sequence[tuple[int, Tensor]]) -> Tensor:
    """Blocks in a matrix of zeros, each from a row on."""
    matrix = like.new_zeros(rows, columns)
    for start, block in blocks:
        matrix[start : start + block.shape[0], : block.shape[1]] = block
    return matrix


def _constants(bounds: Sequence[int], padded: int, width: int) -> dict[str, int]:
    second, third = (*bounds[1:], padded, padded)[:2]
    return {
        "LEVELS": len(bounds),
        "SECOND": second,
        "THIRD": third,
        "PADDED": padded,
        "WIDTH": width,
        **_LAUNCH,
    }


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
