"""The loss of coupled training: how far the network's outputs are from the teacher's.

`reference_divergence` defines it in PyTorch and serves where nothing is compiled. Elsewhere
`learner.kernels.core` computes the loss together with its gradients, much faster.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx

from learner.kernels import core as kernel
from learner.kernels.core import CoreGradients, CoreInputs, CoreSizes
from learner.network.vmdnn import VMDNN
from learner.training.sequences import Minibatch


def divergence(network: VMDNN, minibatch: Minibatch) -> Tensor:
    """Mean divergence of eq. (5); compiled where possible.

    Differentiable once by the parameters of the core, what was seen, `initial` and `shift`.

    Args:
        network: the network; its vision is not used.
        minibatch: sequences on the network's device and of its type.
    """
    if not kernel.supports(minibatch.sequences.seen):
        return reference_divergence(network, minibatch)
    differentiable = (
        minibatch.initial,
        minibatch.shift,
        minibatch.sequences.seen,
        *network.core_parameters(),
    )
    wanted = [
        torch.is_grad_enabled() and each is not None and each.requires_grad
        for each in differentiable
    ]
    result = _Divergence.apply(network, minibatch, wanted, *differentiable)  # type: ignore[no-untyped-call]
    return cast("Tensor", result)


def add_gradients(network: VMDNN, minibatch: Minibatch) -> float:
    """`divergence`; its gradients are added to the `grad` of the core's parameters.

    Equal to calling `backward` on it, but a tenth faster: autograd records nothing.
    """
    if not kernel.supports(minibatch.sequences.seen):
        return backward(reference_divergence(network, minibatch))
    parameters = network.core_parameters()
    gradients = CoreGradients(by_parameters=[_gradient_of(each) for each in parameters])
    return _call_kernel(network, minibatch, gradients)


def backward(loss: Tensor) -> float:
    """Add the gradients of a loss to its parameters' `grad`; returns its value."""
    loss.backward()  # type: ignore[no-untyped-call]
    return loss.item()


def reference_divergence(network: VMDNN, minibatch: Minibatch) -> Tensor:
    """`divergence` in PyTorch; it defines what the compiled kernel computes."""
    return minibatch.divergence(network.act(minibatch.seen(), minibatch.initial))


class _Divergence(torch.autograd.Function):
    """The loss; the kernel computes its gradients in the forward pass."""

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        network: VMDNN,
        minibatch: Minibatch,
        wanted: Sequence[bool],  # which derivatives, in the order of the arguments that follow
        initial: Tensor | None,  # noqa: ARG004 - it and those below are here for autograd to see
        shift: Tensor | None,  # noqa: ARG004
        seen: Tensor,
        *parameters: Tensor,
    ) -> Tensor:
        units = [level.units for level in network.levels()]
        count, steps = len(minibatch.chosen), seen.shape[1]
        by_initial, by_shift, by_seen, *_ = wanted
        gradients = CoreGradients(
            [torch.zeros_like(each) for each in parameters] if any(wanted) else (),
            seen.new_empty(count, steps, units[0]) if by_seen else None,
            seen.new_empty(count, sum(units)) if by_initial else None,
            seen.new_empty(count, units[0]) if by_shift else None,
        )
        loss = _call_kernel(network, minibatch, gradients)
        ctx.gradients, ctx.minibatch = gradients, minibatch  # type: ignore[attr-defined]
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
        gradients: CoreGradients = ctx.gradients
        minibatch: Minibatch = ctx.minibatch
        by_initial, by_shift, by_seen = gradients.by_initial, gradients.by_shift, None
        if by_initial is not None:
            by_initial = by_initial * by_loss
        if by_shift is not None:
            by_shift = (by_shift * by_loss) @ pfc_input
        if gradients.by_drive is not None:
            by_chosen = (gradients.by_drive * by_loss) @ pfc_input
            by_seen = torch.zeros_like(minibatch.sequences.seen)
            by_seen.index_add_(0, minibatch.chosen, by_chosen)
        by_parameters = (each * by_loss for each in gradients.by_parameters)
        return (None, None, None, by_initial, by_shift, by_seen, *by_parameters)


def _call_kernel(network: VMDNN, minibatch: Minibatch, gradients: CoreGradients) -> float:
    """The loss; the kernel leaves the gradients that are asked for."""
    sequences = minibatch.sequences
    levels = network.levels()
    values, softmax_units = network.outputs.shape
    sizes = CoreSizes(
        inputs=network.pfc.input.shape[1],
        units=tuple(level.units for level in levels),
        taus=tuple(level.tau for level in levels),
        values=values,
        softmax_units=softmax_units,
        literal=network.config.update_order == "literal",
    )
    inputs = CoreInputs(
        parameters=network.core_parameters(),
        seen=sequences.seen,
        codes=sequences.codes,
        code_entropies=sequences.code_entropies,
        mask=sequences.mask,
        chosen=minibatch.chosen,
        initial=minibatch.initial,
        shift=minibatch.shift,
    )
    return kernel.divergence(sizes, inputs, gradients)


def _gradient_of(parameter: nn.Parameter) -> Tensor:
    if parameter.grad is None:
        parameter.grad = torch.zeros_like(parameter)
    return parameter.grad
