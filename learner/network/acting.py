"""The interface of a network that acts, one step at a time."""

from __future__ import annotations

from typing import Protocol

from learner.kernels import acting as kernel
from learner.network.compiled_network import CompiledNetwork
from learner.network.numpy_network import NumpyNetwork
from learner.network.subnets import Array, Parameters
from proto.config import NetworkConfig


class ActingNetwork(Protocol):
    """A network that acts; its state is neutral until the first step."""

    def reset(self) -> None:
        """Return to the neutral state."""

    def step(self, image: Array) -> Array:
        """Outputs (11, softmax units) for the image (height, width) seen now, -1..1."""

    def see(self, image: Array) -> Array:
        """The first half of a step: activity (units,) of V_S."""

    def act(self, seen: Array) -> Array:
        """The second half: outputs for what `see` returned."""

    def pfc(self) -> Array:
        """Activity (units,) of the PFC after the last step."""


def make_acting_network(config: NetworkConfig, parameters: Parameters) -> ActingNetwork:
    """A compiled network in float32, or one in numpy where nothing can be compiled.

    Args:
        config: the network's sizes.
        parameters: float32 arrays by name, shaped as `parameter_shapes(config)`.
    """
    if kernel.available():
        return CompiledNetwork(config, parameters)
    return NumpyNetwork(config, parameters)
