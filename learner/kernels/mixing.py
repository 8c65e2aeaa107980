"""Mixtures of sequences on the CPU, a whole minibatch in one call of C++. See `mixing.cpp`."""

from __future__ import annotations

import ctypes
import functools
from typing import Any, Final

import torch
from torch import Tensor

from learner.kernels.library import learning_library
from learner.network.softmax_code import SoftmaxCode
from learner.training.sequences import Sequences

_COUNTS: Final = ("mixtures", "parts", "steps", "inputs", "values", "softmax_units")
_ARRAYS: Final = (
    *("members", "weights", "seen", "targets"),
    *("minima", "maxima", "references", "widths"),
    *("mixed_seen", "codes", "code_entropies"),
)


class _Problem(ctypes.Structure):
    """`MixingProblem` of mixing.cpp, where its members are described."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in _COUNTS),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
    )


def serves(sequences: Sequences) -> bool:
    """Whether the kernel can compute on these sequences, where and of what type they are."""
    seen = sequences.seen
    return seen.device.type == "cpu" and seen.dtype in _functions()


def mixed(
    members: Tensor,
    weights: Tensor,
    sequences: Sequences,
    targets: Tensor,
    code: SoftmaxCode,
    mask: Tensor,
) -> Sequences:
    """`learner.training.interpolation.mixed`, computed by the kernel."""
    seen = sequences.seen.contiguous()
    count, parts = members.shape
    _, steps, inputs = seen.shape
    values, softmax_units = code.references.shape
    made = Sequences(
        seen=seen.new_empty(count, steps, inputs),
        codes=seen.new_empty(count, steps, values, softmax_units),
        mask=mask,
        code_entropies=seen.new_empty(count, steps),
    )
    # named here so that they live as long as the kernel reads them
    ranges = [
        torch.from_numpy(each).to(seen.dtype).contiguous()
        for each in (code.minima, code.maxima, code.references, code.widths)
    ]
    given = [members.contiguous(), weights.to(seen.dtype).contiguous(), seen]
    given += [targets.to(seen.dtype).contiguous(), *ranges]
    arrays = [*given, made.seen, made.codes, made.code_entropies]
    problem = _Problem(
        *(count, parts, steps, inputs, values, softmax_units),
        *(array.data_ptr() for array in arrays),
    )
    _functions()[seen.dtype](ctypes.byref(problem))
    return made


@functools.cache
def _functions() -> dict[torch.dtype, Any]:
    """The kernel by type, none where it cannot be compiled."""
    library = learning_library()
    if library is None:
        return {}
    functions = {torch.float32: library.vmdnn_mix_float, torch.float64: library.vmdnn_mix_double}
    for function in functions.values():
        function.restype = None
        function.argtypes = (ctypes.POINTER(_Problem),)
    return functions
