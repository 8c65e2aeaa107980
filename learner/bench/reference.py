"""The recurrent core as its equations read: step by step, differentiated by PyTorch's autograd.

It is slow. Tests and `vmdnn bench bptt` compare the kernels with it; nothing else uses it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from learner.network.mstnn import activation
from learner.network.vmdnn import VMDNN
from learner.training.sequences import Minibatch


class State(NamedTuple):
    """State of PFC, M_S and M_F between two steps; each tensor is (B, units)."""

    potentials: tuple[Tensor, ...]
    activities: tuple[Tensor, ...]


Step = Callable[[VMDNN, Tensor, State], State]


def stepwise_divergence(network: VMDNN, minibatch: Minibatch) -> Tensor:
    """`learner.training.divergence.divergence`, step by step."""
    return minibatch.divergence(stepwise_outputs(network, minibatch.seen(), minibatch.initial))


def step_levels(network: VMDNN, below: Tensor, state: State) -> State:
    """One step of eq. (1) and (2).

    Args:
        network: the network.
        below: (B, units) activity of V_S; that of the step before if the update order is literal.
        state: state before the step.
    """
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


def stepwise_outputs(
    network: VMDNN, seen: Tensor, initial: Tensor | None = None, step: Step = step_levels
) -> Tensor:
    """`VMDNN.act`, step by step; `step` computes one step of the levels."""
    literal = network.config.update_order == "literal"
    units = [level.units for level in network.levels()]
    if initial is None:
        initial = seen.new_zeros(len(seen), sum(units))
    potentials = torch.split(initial, units, dim=1)
    state = State(potentials, tuple(activation(potential) for potential in potentials))
    before = torch.zeros_like(seen[:, 0])
    outputs = []
    for now in seen.unbind(1):
        fast_before = state.activities[-1]
        state = step(network, before if literal else now, state)
        before = now
        outputs.append(network.outputs(fast_before if literal else state.activities[-1]))
    return torch.stack(outputs, dim=1)
