"""The recurrent scan on a GPU: one launch for all steps of all sequences, forward or backward.

These stand in for the loops of `learner.mtrnn`; all else of the network is PyTorch there.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import logging
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final

import torch
from torch import Tensor

MOST_UNITS: Final = 128
"""Two matrices of so many units squared fit into the registers of one multiprocessor."""

_WARPS: Final = 16
_log = logging.getLogger(__name__)


def serves(tensor: Tensor) -> bool:
    """Whether the kernel can compute on (T, N, B), where it is and for so many units."""
    return tensor.is_cuda and tensor.shape[1] <= MOST_UNITS and _kernels() is not None


def run(
    drive: Tensor, keep: Tensor, initial: Tensor, delayed: Tensor, immediate: Sequence[Tensor]
) -> Tensor:
    """Activities h (T, N, B): v[t] = keep v[t-1] + drive[t] + delayed h[t-1] + immediate h[t].

    h = tanh(v). Arguments as of `learner.mtrnn.recurrent_scan`; `initial` (N, B) is v before.
    """
    steps, units, batch = drive.shape
    by_sequence = drive.permute(2, 0, 1).contiguous()
    hidden = torch.empty_like(by_sequence)
    _kernels().run[(batch,)](
        by_sequence,
        keep.contiguous(),
        initial.T.contiguous(),
        delayed.contiguous(),
        _square(delayed, immediate),
        hidden,
        steps,
        units,
        **_constants(units, immediate),
    )
    return hidden.permute(1, 2, 0)


def run_back(
    by_hidden: Tensor, hidden: Tensor, keep: Tensor, delayed: Tensor, immediate: Sequence[Tensor]
) -> Tensor:
    """dE/dv (T, N, B) from dE/dh, for what `run` gave."""
    steps, units, batch = hidden.shape
    by_sequence = by_hidden.permute(2, 0, 1).contiguous()
    deltas = torch.empty_like(by_sequence)
    _kernels().run_back[(batch,)](
        by_sequence,
        hidden.permute(2, 0, 1).contiguous(),
        keep.contiguous(),
        delayed.T.contiguous(),
        _square(delayed, immediate).T.contiguous(),
        deltas,
        steps,
        units,
        **_constants(units, immediate),
    )
    return deltas.permute(1, 2, 0)


def _square(delayed: Tensor, immediate: Sequence[Tensor]) -> Tensor:
    """The blocks of `immediate` where they belong among all units, (N, N)."""
    square = torch.zeros_like(delayed)
    ends = [len(delayed)]
    for block in reversed(immediate):
        ends.append(ends[-1] - len(block))
    ends.append(0)
    bounds = list(pairwise(reversed(ends)))
    for block, (below, own) in zip(immediate, pairwise(bounds), strict=True):
        square[slice(*own), slice(*below)] = block
    return square


def _constants(units: int, immediate: Sequence[Tensor]) -> dict[str, int]:
    """One sweep through the levels for each that another acts on within the step."""
    padded = max(16, 1 << (units - 1).bit_length())
    return {"SWEEPS": len(immediate), "PADDED": padded, "num_warps": _WARPS}


@functools.cache
def _kernels() -> Any:
    """The kernels, or None without Triton; says once which."""
    if importlib.util.find_spec("triton") is None:
        _log.warning("recurrent scan: in PyTorch, far slower on a GPU: Triton is not installed")
        return None
    _log.info("recurrent scan: Triton")
    return importlib.import_module("learner.kernels.scan")
