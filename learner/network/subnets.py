"""The subnets of VMDNN (paper, section 4.1): sizes and parameters, computed from the config.

Sizes are computed here only. The network that learns (`learner.network.vmdnn`), the networks that
act (`learner.network.acting`) and `vmdnn inspect network` use them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Final

import numpy as np
from numpy.typing import NDArray

from proto.body import ACTION_SIZE, IMAGE_HEIGHT, IMAGE_WIDTH
from proto.config import MapsConfig, NetworkConfig
from proto.errors import UserError

ACTIVATION_GAIN: Final = 1.7159
ACTIVATION_SLOPE: Final = 2 / 3
"""f(x) = 1.7159 tanh(2/3 x), eq. (2): activation of all units but those of V_I and M_O."""

LARGEST_SUBNET: Final = 65_536
"""Units of a subnet; an episode with recorded states holds no more."""
LARGEST_NETWORK: Final = 2**25
"""Parameters of a network: 128 MiB."""

Shape = tuple[int, ...]
Array = NDArray[np.floating]
Parameters = Mapping[str, Array]
"""Arrays by full name, such as `pfc.recurrent`; see `parameter_shapes`."""


@dataclass(frozen=True)
class Subnet:
    """One subnet.

    Attributes:
        name: the paper's name in words; prefix of its parameters' names.
        symbol: the paper's symbol.
        shape: shape of its activity: (maps, height, width), (units,) or (values, softmax units).
        tau: time constant in control steps.
        kernel: (width, height) of the part of the subnet below that one unit sees, or None.
        stride: shift of the kernel between neighbouring units, or None.
        parameters: shape of each parameter by name. `kernel` or `input` weighs the subnet below,
            `recurrent` its own activity, `feedback` that of the subnet above.
    """

    name: str
    symbol: str
    shape: Shape
    tau: float
    kernel: tuple[int, int] | None
    stride: int | None
    parameters: Mapping[str, Shape]

    @property
    def weights(self) -> int:
        """Number of connection weights, biases not counted."""
        return sum(prod(shape) for name, shape in self.parameters.items() if name != "bias")

    @property
    def biases(self) -> int:
        """Number of biases."""
        return prod(self.parameters["bias"]) if self.parameters else 0


def subnets(config: NetworkConfig) -> dict[str, Subnet]:
    """All subnets by name, from the vision input up to the PFC and down to the outputs.

    Raises:
        UserError: a kernel is larger than what it looks at, or the network is too large.
    """
    vision = Subnet("vision_input", "V_I", (1, IMAGE_HEIGHT, IMAGE_WIDTH), 1.0, None, None, {})
    fast = _maps("mstnn_fast", "V_F", vision, config.mstnn_fast)
    slow = _maps("mstnn_slow", "V_S", fast, config.mstnn_slow)
    _, slow_height, slow_width = slow.shape
    pfc, mtrnn_slow, mtrnn_fast = config.pfc, config.mtrnn_slow, config.mtrnn_fast
    chain = (
        vision,
        fast,
        slow,
        Subnet(
            "pfc",
            "PFC",
            (pfc.units,),
            pfc.tau,
            (slow_width, slow_height),  # one kernel covers all of V_S
            1,
            _level_parameters(pfc.units, prod(slow.shape), mtrnn_slow.units),
        ),
        Subnet(
            "mtrnn_slow",
            "M_S",
            (mtrnn_slow.units,),
            mtrnn_slow.tau,
            None,
            None,
            _level_parameters(mtrnn_slow.units, pfc.units, mtrnn_fast.units),
        ),
        Subnet(
            "mtrnn_fast",
            "M_F",
            (mtrnn_fast.units,),
            mtrnn_fast.tau,
            None,
            None,
            _level_parameters(mtrnn_fast.units, mtrnn_slow.units, None),
        ),
        _outputs(config.softmax_units, mtrnn_fast.units),
    )
    _check_sizes(chain)
    return {subnet.name: subnet for subnet in chain}


def parameter_shapes(config: NetworkConfig) -> dict[str, Shape]:
    """Shape of every parameter by its full name, such as `pfc.recurrent`."""
    return {
        f"{subnet.name}.{parameter}": shape
        for subnet in subnets(config).values()
        for parameter, shape in subnet.parameters.items()
    }


def _check_sizes(chain: Sequence[Subnet]) -> None:
    for subnet in chain:
        if prod(subnet.shape) > LARGEST_SUBNET:
            raise UserError(
                f"network.{subnet.name} has {prod(subnet.shape)} units; at most {LARGEST_SUBNET}"
                " are possible: choose fewer maps, or a larger kernel or stride"
            )
    parameters = sum(subnet.weights + subnet.biases for subnet in chain)
    if parameters > LARGEST_NETWORK:
        raise UserError(
            f"the network has {parameters} parameters; at most {LARGEST_NETWORK} are possible:"
            " choose fewer maps or units"
        )


def _maps(name: str, symbol: str, below: Subnet, config: MapsConfig) -> Subnet:
    maps_below, height, width = below.shape
    kernel_width, kernel_height = config.kernel
    if kernel_width > width or kernel_height > height:
        raise UserError(
            f"network.{name}.kernel: {kernel_width} x {kernel_height} (width x height) is larger "
            f"than {below.symbol}, which is {width} x {height}; choose a smaller kernel"
        )
    shape = (
        config.maps,
        (height - kernel_height) // config.stride + 1,
        (width - kernel_width) // config.stride + 1,
    )
    parameters = {
        "kernel": (config.maps, maps_below, kernel_height, kernel_width),
        "bias": (config.maps,),
    }
    return Subnet(name, symbol, shape, config.tau, config.kernel, config.stride, parameters)


def _level_parameters(units: int, below: int, above: int | None) -> dict[str, Shape]:
    feedback = {} if above is None else {"feedback": (units, above)}
    return {
        "input": (units, below),
        "recurrent": (units, units),
        **feedback,
        "bias": (units,),
    }


def _outputs(softmax_units: int, below: int) -> Subnet:
    units = ACTION_SIZE * softmax_units
    return Subnet(
        "outputs",
        "M_O",
        (ACTION_SIZE, softmax_units),
        1.0,
        None,
        None,
        {"input": (units, below), "bias": (units,)},
    )
