"""VMDNN: V_I > V_F > V_S > PFC > M_S > M_F > M_O (paper, figure 1), for whole sequences."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from learner.network.mstnn import Maps, activation
from learner.network.mtrnn import Level, one_step_later, run_levels
from learner.network.subnets import Subnet, subnets
from proto.config import NetworkConfig


class Outputs(nn.Module):
    """M_O: for each action value a softmax over its units.

    Attributes:
        input: (values x softmax units, units of M_F).
        bias: (values x softmax units,).
    """

    input: Tensor
    bias: Tensor

    def __init__(self, subnet: Subnet) -> None:
        super().__init__()
        self.shape = subnet.shape
        for name, shape in subnet.parameters.items():
            self.register_parameter(name, nn.Parameter(torch.zeros(shape)))

    def forward(self, below: Tensor) -> Tensor:
        """Logarithms of the outputs (B, T, values, softmax units) for M_F (B, T, units)."""
        potentials = functional.linear(below, self.input, self.bias)
        by_value = potentials.view(*potentials.shape[:-1], *self.shape)
        return functional.log_softmax(by_value, dim=-1)


class VMDNN(nn.Module):
    """The network for learning: from the images of whole sequences to the outputs of all steps.

    Every sequence starts from the neutral state, zero. Parameters are zero until `initialize`.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        by_name = subnets(config)
        self.config = config
        self.mstnn_fast = Maps(by_name["mstnn_fast"])
        self.mstnn_slow = Maps(by_name["mstnn_slow"])
        self.pfc = Level(by_name["pfc"])
        self.mtrnn_slow = Level(by_name["mtrnn_slow"])
        self.mtrnn_fast = Level(by_name["mtrnn_fast"])
        self.outputs = Outputs(by_name["outputs"])

    def forward(self, images: Tensor) -> Tensor:
        """Logarithms of the outputs (B, T, 11, softmax units) for images (B, T, height, width).

        Brightness is -1..1. Sequences shorter than T may be padded at their end with any images:
        no step depends on a later one.
        """
        return self.act(self.see(images))

    def see(self, images: Tensor) -> Tensor:
        """V_S (B, T, units) for images (B, T, height, width)."""
        fast = self.mstnn_fast(images.unsqueeze(2))
        slow: Tensor = self.mstnn_slow(fast)
        return slow.flatten(2)

    def act(self, seen: Tensor, initial: Tensor | None = None) -> Tensor:
        """Logarithms of the outputs (B, T, 11, softmax units) for V_S (B, T, units).

        Args:
            seen: activity of V_S.
            initial: (B, units of PFC, M_S and M_F) potentials before the first step, or None for
                zero, the neutral state.
        """
        order = self.config.update_order
        fast = run_levels(self.levels(), seen, order, initial)
        if order == "literal":
            before = None if initial is None else activation(initial[:, -fast.shape[-1] :])
            fast = one_step_later(fast, before)
        outputs: Tensor = self.outputs(fast)
        return outputs

    def levels(self) -> tuple[Level, Level, Level]:
        """PFC, M_S and M_F."""
        return self.pfc, self.mtrnn_slow, self.mtrnn_fast

    def core_parameters(self) -> list[nn.Parameter]:
        """Parameters of PFC, M_S, M_F and M_O, ordered as in `learner.kernels.core.CoreInputs`."""
        parameters = []
        for level in self.levels():
            parameters += [level.input, level.recurrent, level.feedback, level.bias]
        parameters += [self.outputs.input, self.outputs.bias]
        return [cast("nn.Parameter", each) for each in parameters if each is not None]

    def vision(self) -> tuple[Maps, Maps]:
        """V_F and V_S: pre-training trains them, coupled training does not."""
        return self.mstnn_fast, self.mstnn_slow

    def coupled_parameters(self) -> list[nn.Parameter]:
        """The parameters that coupled training trains: all but the vision's (section 3.3)."""
        coupled = (*self.levels(), self.outputs)
        return [parameter for module in coupled for parameter in module.parameters()]

    def initialize(
        self, generator: torch.Generator, *, initial_range: float, pfc_input_range: float
    ) -> None:
        """Draw every parameter uniformly from -range..range.

        Args:
            generator: draws them.
            initial_range: range of all parameters but those below.
            pfc_input_range: range of the weights from V_S to the PFC.
        """
        with torch.no_grad():
            for name, parameter in self.named_parameters():
                limit = pfc_input_range if name == "pfc.input" else initial_range
                parameter.uniform_(-limit, limit, generator=generator)
