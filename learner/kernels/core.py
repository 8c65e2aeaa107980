"""The recurrent core PFC > M_S > M_F > M_O on the CPU: one call of C++ for a minibatch.

A call computes the loss and, where asked for, its gradients (`core.cpp`). It reads the chosen
sequences where they lie in memory.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from learner.kernels.typed import TypedKernel

_COUNTS: Final = (
    *("levels", "inputs", "values", "softmax_units"),
    *("literal", "sequences", "steps", "threads"),
)
_ARRAYS: Final = (
    *("units", "leaks", "chosen", "seen", "codes", "code_entropies", "mask"),
    *("initial", "shift", "parameters", "divergence"),
    *("by_parameters", "by_drive", "by_initial", "by_shift"),
)


class _Problem(ctypes.Structure):
    """`CoreProblem` of core.cpp, where its members are described."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in _COUNTS),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
    )


_KERNEL: Final = TypedKernel("vmdnn_core", (ctypes.POINTER(_Problem),), ctypes.c_int)

supports = _KERNEL.supports


@dataclass(frozen=True)
class CoreSizes:
    """Sizes and time constants of the core.

    Attributes:
        inputs: units of V_S.
        units: units of PFC, M_S and M_F.
        taus: their time constants in control steps.
        values: values of an action.
        softmax_units: units of M_O for each value.
        literal: every connection takes one step, as eq. (1) is printed.
    """

    inputs: int
    units: tuple[int, ...]
    taus: tuple[float, ...]
    values: int
    softmax_units: int
    literal: bool


@dataclass(frozen=True)
class CoreInputs:
    """What the loss depends on; all floating point arrays are of one type.

    Attributes:
        parameters: for each level input, recurrent, feedback (all levels but the last) and bias;
            then input and bias of the outputs. Contiguous.
        seen: (S, T, inputs) activity of V_S.
        codes: (S, T, values, softmax units) the teacher's outputs.
        code_entropies: (S, T) sum of codes * log(codes).
        mask: (S, T) one where a sequence has a step.
        chosen: (B,) int64 indices of the sequences in the minibatch.
        initial: (B, units of all levels) potentials before the first step, or None for zero.
        shift: (B, inputs) added to `seen` at every step, or None.
    """

    parameters: Sequence[Tensor]
    seen: Tensor
    codes: Tensor
    code_entropies: Tensor
    mask: Tensor
    chosen: Tensor
    initial: Tensor | None = None
    shift: Tensor | None = None


@dataclass(frozen=True)
class CoreGradients:
    """Where a call leaves gradients; None for those that are not asked for.

    Attributes:
        by_parameters: in the order of `CoreInputs.parameters`; gradients are added to them. They
            must be given if any other gradient is.
        by_drive: (B, T, units of the PFC) by the input that the PFC gets from V_S.
        by_initial: (B, units of all levels).
        by_shift: (B, units of the PFC) by the input that the PFC gets from the shift.
    """

    by_parameters: Sequence[Tensor] = ()
    by_drive: Tensor | None = None
    by_initial: Tensor | None = None
    by_shift: Tensor | None = None


def divergence(sizes: CoreSizes, inputs: CoreInputs, gradients: CoreGradients) -> float:
    """The mean divergence of eq. (5) over a minibatch; leaves the gradients that are asked for.

    Args:
        sizes: sizes of the core.
        inputs: arrays that the loss depends on; `supports(inputs.seen)` must hold.
        gradients: arrays that get the gradients.

    Raises:
        ValueError: an array has another shape or type than the sizes ask for.
        IndexError: `chosen` names a sequence that does not exist.
        MemoryError: there is not enough memory.
    """
    _check(sizes, inputs)
    seen = inputs.seen.contiguous()
    # named, so that these arrays live until the kernel has read them
    codes, entropies = inputs.codes.contiguous(), inputs.code_entropies.contiguous()
    mask, chosen = inputs.mask.contiguous(), inputs.chosen.contiguous()
    initial = None if inputs.initial is None else inputs.initial.contiguous()
    shift = None if inputs.shift is None else inputs.shift.contiguous()
    loss = ctypes.c_double()
    units = (ctypes.c_int32 * len(sizes.units))(*sizes.units)
    leaks = (ctypes.c_double * len(sizes.taus))(*(1 / tau for tau in sizes.taus))
    parameters = _addresses(inputs.parameters)
    by_parameters = _addresses(gradients.by_parameters)
    problem = _Problem(
        levels=len(sizes.units),
        inputs=sizes.inputs,
        values=sizes.values,
        softmax_units=sizes.softmax_units,
        literal=sizes.literal,
        sequences=len(chosen),
        steps=seen.shape[1],
        threads=torch.get_num_threads(),
        units=ctypes.addressof(units),
        leaks=ctypes.addressof(leaks),
        chosen=chosen.data_ptr(),
        seen=seen.data_ptr(),
        codes=codes.data_ptr(),
        code_entropies=entropies.data_ptr(),
        mask=mask.data_ptr(),
        initial=_address(initial),
        shift=_address(shift),
        parameters=ctypes.addressof(parameters),
        divergence=ctypes.addressof(loss),
        by_parameters=ctypes.addressof(by_parameters) if gradients.by_parameters else None,
        by_drive=_address(gradients.by_drive),
        by_initial=_address(gradients.by_initial),
        by_shift=_address(gradients.by_shift),
    )
    if _KERNEL(seen.dtype, ctypes.byref(problem)) != 0:
        raise MemoryError(f"the recurrent core has no memory for {len(chosen)} sequences")
    return loss.value


def _check(sizes: CoreSizes, inputs: CoreInputs) -> None:
    """The kernel follows sizes and indices without checking them."""
    count, steps = inputs.mask.shape
    minibatch = len(inputs.chosen)
    tensors: list[tuple[str, Tensor | None, tuple[int, ...]]] = [
        ("seen", inputs.seen, (count, steps, sizes.inputs)),
        ("codes", inputs.codes, (count, steps, sizes.values, sizes.softmax_units)),
        ("mask", inputs.mask, (count, steps)),
        ("code_entropies", inputs.code_entropies, (count, steps)),
        ("initial", inputs.initial, (minibatch, sum(sizes.units))),
        ("shift", inputs.shift, (minibatch, sizes.inputs)),
    ]
    for parameter, shape in zip(inputs.parameters, _parameter_shapes(sizes), strict=True):
        tensors.append(("a parameter", parameter, shape))
    dtype = inputs.parameters[0].dtype
    for name, tensor, shape in tensors:
        if tensor is not None and (tensor.shape != shape or tensor.dtype != dtype):
            raise ValueError(
                f"{name} is {tuple(tensor.shape)} {tensor.dtype}, but the network needs"
                f" {shape} {dtype}"
            )
    if inputs.chosen.dtype != torch.int64 or minibatch == 0:
        raise ValueError(f"chosen is {minibatch} {inputs.chosen.dtype}, but must be some int64")
    indices = inputs.chosen.tolist()
    if not 0 <= min(indices) <= max(indices) < count:
        raise IndexError(f"chosen is {indices}, but there are {count} sequences")


def _parameter_shapes(sizes: CoreSizes) -> list[tuple[int, ...]]:
    """Shapes of `CoreInputs.parameters`."""
    shapes: list[tuple[int, ...]] = []
    below = sizes.inputs
    for units, above in zip(sizes.units, (*sizes.units[1:], None), strict=True):
        shapes += [(units, below), (units, units)]
        if above is not None:
            shapes.append((units, above))
        shapes.append((units,))
        below = units
    outputs = sizes.values * sizes.softmax_units
    return [*shapes, (outputs, below), (outputs,)]


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def _addresses(tensors: Sequence[Tensor]) -> ctypes.Array[ctypes.c_void_p]:
    if not all(tensor.is_contiguous() for tensor in tensors):
        raise ValueError("a parameter or its gradient is not contiguous")
    return (ctypes.c_void_p * len(tensors))(*(tensor.data_ptr() for tensor in tensors))
