"""The recurrent core as its equations read: one step after the other, with PyTorch's own autograd.

Slow. It is what the kernels are tested against and what `vmdnn bench bptt` compares them with.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from learner.network.mstnn import activation
from learner.network.vmdnn import VMDNN
from learner.training.loss import kl_divergence
from learner.training.sequences import Sequences


class State(NamedTuple):
    """What goes from step to step, for PFC, M_S and M_F; each (B, units)."""

    potentials: tuple[Tensor, ...]
    activities: tuple[Tensor, ...]


Step = Callable[[VMDNN, Tensor, State], State]


def plain_divergence(
    network: VMDNN,
    sequences: Sequences,
    chosen: Tensor,
    initial: Tensor | None = None,
    shift: Tensor | None = None,
) -> Tensor:
    """`learner.training.divergence.divergence`, step by step."""
    seen = sequences.seen[chosen]
    if shift is not None:
        seen = seen + shift[:, None]
    log_outputs = plain_outputs(network, seen, initial)
    return kl_divergence(log_outputs, sequences.codes[chosen], sequences.mask[chosen])


def plain_step(network: VMDNN, below: Tensor, state: State) -> State:
    """One step: eq. (1) and (2). `below` is V_S, of the step before if the order is literal."""
    literal = network.config.update_order == "literal"
    before = state.activities
    potentials, activities = [], []
    for index, level in enumerate(network.levels()):
        drive = functional.linear(below, level.input, level.bias)
        drive = drive + functional.linear(before[index], level.recurrent)
        if level.feedback is not None:
            drive = drive + functional.linear(before[index + 1], level.feedback)
        leak = 1 / level.tau
        potentials.append((1 - leak) * state.potentials[index] + leak * drive)
        activities.append(activation(potentials[-1]))
        below = before[index] if literal else activities[-1]
    return State(tuple(potentials), tuple(activities))


def plain_outputs(
    network: VMDNN, seen: Tensor, initial: Tensor | None = None, step: Step = plain_step
) -> Tensor:
    """`VMDNN.act`, step by step."""
    literal = network.config.update_order == "literal"
    units = [level.units for level in network.levels()]
    if initial is None:
        initial = seen.new_zeros(len(seen), sum(units))
    potentials = torch.split(initial, units, dim=1)
    state = State(potentials, tuple(activation(potential) for potential in potentials))
    before = torch.zeros_like(seen[:, 0])
    outputs = []
    for now in seen.unbind(1):
        shown = state.activities[-1]
        state = step(network, before if literal else now, state)
        before = now
        outputs.append(network.outputs(shown if literal else state.activities[-1]))
    return torch.stack(outputs, dim=1)
