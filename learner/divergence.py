"""The loss of coupled training: how far the network's outputs are from the teacher's.

There is one definition, in PyTorch, and kernels that compute the same, with its gradients, faster.
"""

from __future__ import annotations

from torch import Tensor

from learner.kernels import cpu
from learner.loss import kl_divergence
from learner.sequences import Sequences
from learner.vmdnn import VMDNN


def divergence(
    network: VMDNN, sequences: Sequences, chosen: Tensor, initial: Tensor | None = None
) -> Tensor:
    """Mean divergence of eq. (5), for the sequences with these indices.

    Differentiable once by the network's coupled parameters, what was seen and `initial`; by the
    compiled kernel where there is one.

    Args:
        network: the network, of which the vision is not used.
        sequences: all sequences, on the network's device and of its type.
        chosen: (B,) which of them.
        initial: (B, units of PFC, M_S and M_F) their potentials before the first step; without it
            zero, the neutral state.
    """
    if cpu.serves(sequences):
        return cpu.divergence(network, sequences, chosen, initial)
    return reference_divergence(network, sequences, chosen, initial)


def reference_divergence(
    network: VMDNN, sequences: Sequences, chosen: Tensor, initial: Tensor | None = None
) -> Tensor:
    """What `divergence` means, in PyTorch."""
    log_outputs = network.act(sequences.seen[chosen], initial)
    return kl_divergence(log_outputs, sequences.codes[chosen], sequences.mask[chosen])
