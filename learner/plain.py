"""The recurrent core as its equations read: one step after the other, with PyTorch's own autograd.

Slow. It is what the kernels are tested against and what `vmdnn bench bptt` compares them with.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from learner.loss import kl_divergence
from learner.mstnn import activation
from learner.sequences import Sequences
from learner.vmdnn import VMDNN


def plain_divergence(
    network: VMDNN, sequences: Sequences, chosen: Tensor, initial: Tensor | None = None
) -> Tensor:
    """`learner.divergence.divergence`, step by step."""
    log_outputs = plain_outputs(network, sequences.seen[chosen], initial)
    return kl_divergence(log_outputs, sequences.codes[chosen], sequences.mask[chosen])


def plain_outputs(network: VMDNN, seen: Tensor, initial: Tensor | None = None) -> Tensor:
    """`VMDNN.act`, step by step: eq. (1) and (2)."""
    levels = network.levels()
    literal = network.config.update_order == "literal"
    units = [level.units for level in levels]
    if initial is None:
        initial = seen.new_zeros(len(seen), sum(units))
    potentials = list(torch.split(initial, units, dim=1))
    activities = [activation(potential) for potential in potentials]
    nothing = torch.zeros_like(seen[:, 0])
    outputs = []
    for step in range(seen.shape[1]):
        before = list(activities)
        below = seen[:, step]
        if literal:
            below = seen[:, step - 1] if step else nothing
        for index, level in enumerate(levels):
            drive = functional.linear(below, level.input, level.bias)
            drive = drive + functional.linear(before[index], level.recurrent)
            if level.feedback is not None:
                drive = drive + functional.linear(before[index + 1], level.feedback)
            leak = 1 / level.tau
            potentials[index] = (1 - leak) * potentials[index] + leak * drive
            activities[index] = activation(potentials[index])
            below = before[index] if literal else activities[index]
        outputs.append(network.outputs(below))
    return torch.stack(outputs, dim=1)
