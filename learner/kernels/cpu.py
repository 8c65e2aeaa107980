"""The recurrent core on the CPU: one call of C++ computes the loss and all its gradients.

The kernel works on a whole minibatch at once and reads the chosen sequences where they lie. See
`core.cpp` for how.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx

from learner.kernels.library import learning_library
from learner.network.vmdnn import VMDNN
from learner.training.sequences import Sequences

_COUNTS: Final = (
    *("levels", "inputs", "values", "softmax_units"),
    *("literal", "sequences", "steps", "threads"),
)
_ARRAYS: Final = (
    *(
        "units",
        "leaks",
        "chosen",
        "seen",
        "targets",
        "target_entropies",
        "mask",
        "initial",
        "shift",
    ),
    *("parameters", "divergence", "by_parameters", "by_drive", "by_initial", "by_shift"),
)


class _Problem(ctypes.Structure):
    """`Problem` of core.cpp, where its members are described."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in _COUNTS),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
    )


def serves(sequences: Sequences) -> bool:
    """Whether the kernel can compute on these sequences, where and of what type they are."""
    seen = sequences.seen
    return seen.device.type == "cpu" and seen.dtype in _functions()


def divergence(
    network: VMDNN,
    sequences: Sequences,
    chosen: Tensor,
    initial: Tensor | None = None,
    shift: Tensor | None = None,
) -> Tensor:
    """`learner.training.divergence.divergence`, computed by the kernel."""
    differentiable = (initial, shift, sequences.seen, *network.core_parameters())
    wanted = [
        torch.is_grad_enabled() and each is not None and each.requires_grad
        for each in differentiable
    ]
    result = _Divergence.apply(  # type: ignore[no-untyped-call]
        network, sequences, chosen, wanted, *differentiable
    )
    return cast("Tensor", result)


def add_gradients(
    network: VMDNN, sequences: Sequences, chosen: Tensor, shift: Tensor | None = None
) -> float:
    """`learner.training.divergence.add_gradients`, computed by the kernel."""
    parameters = network.core_parameters()
    gradients = _Gradients(by_parameters=[_gradient_of(each) for each in parameters])
    return _call(network, sequences, chosen, None, shift, parameters, gradients)


def _gradient_of(parameter: nn.Parameter) -> Tensor:
    if parameter.grad is None:
        parameter.grad = torch.zeros_like(parameter)
    return parameter.grad


@dataclass(frozen=True)
class _Gradients:
    """Where a call of the kernel leaves gradients; None for what is not asked for.

    Attributes:
        by_parameters: in the order of `VMDNN.core_parameters`; is added to. Must be there if
            any other is.
        by_drive: (B, T, units of the PFC) by what V_S brings there.
        by_initial: (B, units of all levels).
        by_shift: (B, units of the PFC) by what the shift of V_S brings there.
    """

    by_parameters: Sequence[Tensor] | None = None
    by_drive: Tensor | None = None
    by_initial: Tensor | None = None
    by_shift: Tensor | None = None


class _Divergence(torch.autograd.Function):
    """The loss; its gradients are computed along with it."""

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        network: VMDNN,
        sequences: Sequences,
        chosen: Tensor,
        wanted: Sequence[bool],  # of the derivatives by what follows
        initial: Tensor | None,
        shift: Tensor | None,
        seen: Tensor,
        *parameters: Tensor,
    ) -> Tensor:
        units = [level.units for level in network.levels()]
        count, steps = len(chosen), seen.shape[1]
        by_initial, by_shift, by_seen, *_ = wanted
        gradients = _Gradients(
            [torch.zeros_like(each) for each in parameters] if any(wanted) else None,
            seen.new_empty(count, steps, units[0]) if by_seen else None,
            seen.new_empty(count, sum(units)) if by_initial else None,
            seen.new_empty(count, units[0]) if by_shift else None,
        )
        loss = _call(network, sequences, chosen, initial, shift, parameters, gradients)
        ctx.gradients, ctx.chosen, ctx.seen_shape = gradients, chosen, seen.shape  # type: ignore[attr-defined]
        ctx.save_for_backward(network.pfc.input)
        return seen.new_tensor(loss)

    @staticmethod
    def backward(ctx: Any, *by_outputs: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError(
                "the compiled recurrent core gives first derivatives only, so create_graph=True"
                " does not work on it; use reference_divergence"
            )
        (by_loss,) = by_outputs
        (pfc_input,) = ctx.saved_tensors
        gradients: _Gradients = ctx.gradients
        by_initial, by_shift, by_seen = gradients.by_initial, gradients.by_shift, None
        if by_initial is not None:
            by_initial = by_initial * by_loss
        if by_shift is not None:
            by_shift = (by_shift * by_loss) @ pfc_input
        if gradients.by_drive is not None:
            by_chosen = (gradients.by_drive * by_loss) @ pfc_input
            by_seen = by_chosen.new_zeros(ctx.seen_shape).index_add_(0, ctx.chosen, by_chosen)
        by_parameters = (each * by_loss for each in gradients.by_parameters or ())
        return (None, None, None, None, by_initial, by_shift, by_seen, *by_parameters)


def _call(
    network: VMDNN,
    sequences: Sequences,
    chosen: Tensor,
    initial: Tensor | None,
    shift: Tensor | None,
    parameters: Sequence[Tensor],
    gradients: _Gradients,
) -> float:
    """The loss, by the kernel, which leaves the gradients."""
    seen, codes = sequences.seen.contiguous(), sequences.codes.contiguous()
    mask, entropies = sequences.mask.contiguous(), sequences.code_entropies.contiguous()
    levels = network.levels()
    units = [level.units for level in levels]
    _check(network, sequences, chosen, initial, shift)
    chosen = chosen.contiguous()
    initial = None if initial is None else initial.contiguous()
    shift = None if shift is None else shift.contiguous()
    loss = ctypes.c_double()
    c_units = (ctypes.c_int32 * len(units))(*units)
    c_leaks = (ctypes.c_double * len(units))(*(1 / level.tau for level in levels))
    c_parameters = _addresses(parameters)
    c_by_parameters = _addresses(gradients.by_parameters or ())
    problem = _Problem(
        levels=len(units),
        inputs=seen.shape[2],
        values=codes.shape[2],
        softmax_units=codes.shape[3],
        literal=network.config.update_order == "literal",
        sequences=len(chosen),
        steps=seen.shape[1],
        threads=torch.get_num_threads(),
        units=ctypes.addressof(c_units),
        leaks=ctypes.addressof(c_leaks),
        chosen=chosen.data_ptr(),
        seen=seen.data_ptr(),
        targets=codes.data_ptr(),
        target_entropies=entropies.data_ptr(),
        mask=mask.data_ptr(),
        initial=_address(initial),
        shift=_address(shift),
        parameters=ctypes.addressof(c_parameters),
        divergence=ctypes.addressof(loss),
        by_parameters=ctypes.addressof(c_by_parameters) if gradients.by_parameters else None,
        by_drive=_address(gradients.by_drive),
        by_initial=_address(gradients.by_initial),
        by_shift=_address(gradients.by_shift),
    )
    if _functions()[seen.dtype](ctypes.byref(problem)) != 0:
        raise MemoryError(f"the recurrent core has no memory for {len(chosen)} sequences")
    return loss.value


def _check(
    network: VMDNN,
    sequences: Sequences,
    chosen: Tensor,
    initial: Tensor | None,
    shift: Tensor | None,
) -> None:
    """The kernel follows sizes and indices without looking."""
    count, steps = sequences.mask.shape
    like = network.pfc.input
    expected = {
        "seen": (sequences.seen, (count, steps, like.shape[1])),
        "codes": (sequences.codes, (count, steps, *network.outputs.shape)),
        "mask": (sequences.mask, (count, steps)),
        "code_entropies": (sequences.code_entropies, (count, steps)),
    }
    if initial is not None:
        units = sum(level.units for level in network.levels())
        expected["initial"] = (initial, (len(chosen), units))
    if shift is not None:
        expected["shift"] = (shift, (len(chosen), like.shape[1]))
    for name, (tensor, shape) in expected.items():
        if tensor.shape != shape or tensor.dtype != like.dtype:
            raise ValueError(
                f"{name} is {tuple(tensor.shape)} {tensor.dtype}, but the network needs"
                f" {tuple(shape)} {like.dtype}"
            )
    if chosen.dtype != torch.int64 or len(chosen) == 0:
        raise ValueError(f"chosen is {len(chosen)} {chosen.dtype}, but must be some int64")
    indices = chosen.tolist()
    if not 0 <= min(indices) <= max(indices) < count:
        raise IndexError(f"chosen is {indices}, but there are {count} sequences")


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def _addresses(tensors: Sequence[Tensor]) -> ctypes.Array[ctypes.c_void_p]:
    if not all(tensor.is_contiguous() for tensor in tensors):
        raise ValueError("a parameter or its gradient is not contiguous")
    return (ctypes.c_void_p * len(tensors))(*(tensor.data_ptr() for tensor in tensors))


@functools.cache
def _functions() -> dict[torch.dtype, Any]:
    """The kernel by type, none where it cannot be compiled."""
    library = learning_library()
    if library is None:
        return {}
    return {torch.float32: library.vmdnn_core_float, torch.float64: library.vmdnn_core_double}
