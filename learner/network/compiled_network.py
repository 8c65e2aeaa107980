"""VMDNN one step at a time, compiled, in float32."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from learner.kernels.acting import ActingKernel, LevelSizes, MapsSizes, NetworkSizes
from learner.network.subnets import Array, Parameters, Subnet, parameter_shapes, subnets
from proto.config import NetworkConfig


class CompiledNetwork:
    """An `ActingNetwork` in C++; to float32 it gives the numbers of `NumpyNetwork`."""

    def __init__(self, config: NetworkConfig, parameters: Parameters) -> None:
        """Copy the parameters into a compiled network.

        Args:
            config: the network's sizes.
            parameters: arrays by name, shaped as `parameter_shapes(config)`.

        Raises:
            RuntimeError: the kernels are not compiled here.
            ValueError: a parameter has another shape.
        """
        shapes = parameter_shapes(config)
        for name, shape in shapes.items():
            if parameters[name].shape != shape:
                raise ValueError(f"{name} is {parameters[name].shape}, but must be {shape}")
        in_order = [np.asarray(parameters[name], np.float32) for name in shapes]
        self._kernel = ActingKernel(_sizes(config, subnets(config)), in_order)

    def reset(self) -> None:
        """Return to the neutral state."""
        self._kernel.reset()

    def step(self, image: Array) -> Array:
        """Outputs (11, softmax units) for the image (height, width) seen now, -1..1."""
        kernel = self._kernel
        np.copyto(kernel.image, image)
        kernel.see()
        kernel.act()
        return kernel.outputs.copy()

    def see(self, image: Array) -> Array:
        """The first half of a step: activity (units,) of V_S."""
        np.copyto(self._kernel.image, image)
        self._kernel.see()
        return self._kernel.seen.copy()

    def act(self, seen: Array) -> Array:
        """The second half: outputs for what `see` returned."""
        np.copyto(self._kernel.seen, seen)
        self._kernel.act()
        return self._kernel.outputs.copy()

    def pfc(self) -> Array:
        """Activity (units,) of the PFC after the last step."""
        self._kernel.look_at_pfc()
        return self._kernel.pfc.copy()


def _sizes(config: NetworkConfig, by_name: Mapping[str, Subnet]) -> NetworkSizes:
    _, height, width = by_name["vision_input"].shape
    values, softmax_units = by_name["outputs"].shape
    return NetworkSizes(
        image=(height, width),
        maps=(_maps_sizes(by_name["mstnn_fast"]), _maps_sizes(by_name["mstnn_slow"])),
        levels=(
            _level_sizes(by_name["pfc"]),
            _level_sizes(by_name["mtrnn_slow"]),
            _level_sizes(by_name["mtrnn_fast"]),
        ),
        values=values,
        softmax_units=softmax_units,
        literal=config.update_order == "literal",
    )


def _maps_sizes(subnet: Subnet) -> MapsSizes:
    maps, height, width = subnet.shape
    kernel_height, kernel_width = subnet.parameters["kernel"][2:]
    stride = subnet.stride or 1
    return MapsSizes(maps, height, width, kernel_height, kernel_width, stride, subnet.tau)


def _level_sizes(subnet: Subnet) -> LevelSizes:
    return LevelSizes(subnet.shape[0], subnet.tau)
