"""The loss of coupled training: how far the network's outputs are from the teacher's.

There is one definition, in PyTorch, and kernels that compute the same, with its gradients, faster.
"""

from __future__ import annotations

from torch import Tensor

from learner.kernels import cpu
from learner.network.vmdnn import VMDNN
from learner.training.loss import kl_divergence
from learner.training.sequences import Sequences


def divergence(
    network: VMDNN,
    sequences: Sequences,
    chosen: Tensor,
    initial: Tensor | None = None,
    shift: Tensor | None = None,
) -> Tensor:
    """Mean divergence of eq. (5), for the sequences with these indices.

    Differentiable once by the coupled parameters, what was seen, `initial` and `shift`; by
    the compiled kernel where there is one.

    Args:
        network: the network, of which the vision is not used.
        sequences: all sequences, on the network's device and of its type.
        chosen: (B,) which of them.
        initial: (B, units of PFC, M_S and M_F) their potentials before the first step; without it
            zero, the neutral state.
        shift: (B, V_S units) what is added to all that was seen.
    """
    if cpu.serves(sequences):
        return cpu.divergence(network, sequences, chosen, initial, shift)
    return reference_divergence(network, sequences, chosen, initial, shift)


def add_gradients(
    network: VMDNN, sequences: Sequences, chosen: Tensor, shift: Tensor | None = None
) -> float:
    """`divergence`; its gradients are added to the `grad` of the coupled parameters.

    The same as calling `backward` on it, but faster: for so small a network, recording what is to
    be differentiated takes a tenth of the time.
    """
    if cpu.serves(sequences):
        return cpu.add_gradients(network, sequences, chosen, shift)
    loss = reference_divergence(network, sequences, chosen, shift=shift)
    loss.backward()  # type: ignore[no-untyped-call]
    return loss.item()


def reference_divergence(
    network: VMDNN,
    sequences: Sequences,
    chosen: Tensor,
    initial: Tensor | None = None,
    shift: Tensor | None = None,
) -> Tensor:
    """What `divergence` means, in PyTorch."""
    seen = sequences.seen[chosen]
    if shift is not None:
        seen = seen + shift[:, None]
    log_outputs = network.act(seen, initial)
    return kl_divergence(log_outputs, sequences.codes[chosen], sequences.mask[chosen])
