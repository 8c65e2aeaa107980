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
from torch import Tensor
from torch.autograd.function import FunctionCtx

from learner.kernels.library import learning_library
from learner.sequences import Sequences
from learner.vmdnn import VMDNN

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
    """`learner.divergence.divergence`, computed by the kernel."""
    # The kernel reads what was seen where it lies; that all of it is shifted it learns in the PFC.
    drive_shift = None if shift is None else shift @ network.pfc.input.T
    parameters = torch.cat([each.view(-1) for each in network.core_parameters()])
    differentiable = (initial, drive_shift, sequences.seen, parameters)
    wanted = [
        torch.is_grad_enabled() and each is not None and each.requires_grad
        for each in differentiable
    ]
    result = _Divergence.apply(  # type: ignore[no-untyped-call]
        network, sequences, chosen, wanted, *differentiable
    )
    return cast("Tensor", result)


@dataclass(frozen=True)
class _Gradients:
    """What one call of the kernel leaves; None for what was not asked for."""

    by_parameters: Tensor | None
    by_drive: Tensor | None
    by_initial: Tensor | None
    by_shift: Tensor | None


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
        parameters: Tensor,
    ) -> Tensor:
        loss, gradients = _call(network, sequences, chosen, initial, shift, parameters, wanted)
        ctx.gradients, ctx.chosen, ctx.seen_shape = gradients, chosen, seen.shape  # type: ignore[attr-defined]
        ctx.save_for_backward(parameters)
        return seen.new_tensor(loss)

    @staticmethod
    def backward(ctx: Any, *by_outputs: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError(
                "the compiled recurrent core gives first derivatives only, so create_graph=True"
                " does not work on it; differentiate learner.divergence.reference_divergence"
            )
        (by_loss,) = by_outputs
        gradients: _Gradients = ctx.gradients
        by_seen = None
        if gradients.by_drive is not None:
            (parameters,) = ctx.saved_tensors
            units, inputs = gradients.by_drive.shape[2], ctx.seen_shape[2]
            by_chosen = (gradients.by_drive * by_loss) @ parameters[: units * inputs].view(
                units, -1
            )
            by_seen = by_chosen.new_zeros(ctx.seen_shape).index_add_(0, ctx.chosen, by_chosen)
        by_others = (
            None if each is None else each * by_loss
            for each in (gradients.by_initial, gradients.by_shift, gradients.by_parameters)
        )
        by_initial, by_shift, by_parameters = by_others
        return (None, None, None, None, by_initial, by_shift, by_seen, by_parameters)


def _call(
    network: VMDNN,
    sequences: Sequences,
    chosen: Tensor,
    initial: Tensor | None,
    shift: Tensor | None,
    parameters: Tensor,
    wanted: Sequence[bool],
) -> tuple[float, _Gradients]:
    seen, codes = sequences.seen.contiguous(), sequences.codes.contiguous()
    mask, entropies = sequences.mask.contiguous(), sequences.code_entropies.contiguous()
    levels = network.levels()
    units = [level.units for level in levels]
    _check(network, sequences, chosen, initial, shift)
    chosen = chosen.contiguous()
    initial = None if initial is None else initial.contiguous()
    shift = None if shift is None else shift.contiguous()
    by_initial, by_shift, by_seen, *_ = wanted
    gradients = _Gradients(
        torch.empty_like(parameters) if any(wanted) else None,
        seen.new_empty(len(chosen), seen.shape[1], units[0]) if by_seen else None,
        seen.new_empty(len(chosen), sum(units)) if by_initial else None,
        seen.new_empty(len(chosen), units[0]) if by_shift else None,
    )
    loss = ctypes.c_double()
    c_units = (ctypes.c_int32 * len(units))(*units)
    c_leaks = (ctypes.c_double * len(units))(*(1 / level.tau for level in levels))
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
        parameters=parameters.data_ptr(),
        divergence=ctypes.addressof(loss),
        by_parameters=_address(gradients.by_parameters),
        by_drive=_address(gradients.by_drive),
        by_initial=_address(gradients.by_initial),
        by_shift=_address(gradients.by_shift),
    )
    if _functions()[seen.dtype](ctypes.byref(problem)) != 0:
        raise MemoryError(f"the recurrent core has no memory for {len(chosen)} sequences")
    return loss.value, gradients


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
        expected["shift, in the PFC,"] = (shift, (len(chosen), network.pfc.units))
    for name, (tensor, shape) in expected.items():
        if tensor.shape != shape or tensor.dtype != like.dtype:
            raise ValueError(
                f"{name} is {tuple(tensor.shape)} {tensor.dtype}, but the network needs"
                f" {tuple(shape)} {like.dtype}"
            )
    if chosen.dtype != torch.int64 or len(chosen) == 0:
        raise ValueError(f"chosen is {len(chosen)} {chosen.dtype}, but must be some int64")
    if not 0 <= int(chosen.min()) <= int(chosen.max()) < count:
        raise IndexError(f"chosen is {chosen.tolist()}, but there are {count} sequences")


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


@functools.cache
def _functions() -> dict[torch.dtype, Any]:
    """The kernel by type, none where it cannot be compiled."""
    library = learning_library()
    if library is None:
        return {}
    return {torch.float32: library.vmdnn_core_float, torch.float64: library.vmdnn_core_double}
