"""VMDNN one step at a time (paper, section 3.2), in numpy: no gradients and no PyTorch.

It gives the numbers that `learner.network.vmdnn` gives for a whole sequence.

An image is read as one row of numbers, image row after image row. The image rows that one row of
units sees are neighbours in it. So a strided convolution is one matrix product: overlapping
stretches of the long row times a band matrix, which holds the kernel once for each unit of a row.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from learner.network.subnets import (
    ACTIVATION_GAIN,
    ACTIVATION_SLOPE,
    Array,
    Parameters,
    Subnet,
    subnets,
)
from proto.config import NetworkConfig


class NumpyNetwork:
    """An `ActingNetwork` in numpy."""

    def __init__(self, config: NetworkConfig, parameters: Parameters) -> None:
        """Lay out the parameters; they are not copied where their layout already fits.

        Args:
            config: the network's sizes.
            parameters: float32 or float64 arrays by name, shaped as `parameter_shapes(config)`.
        """
        by_name = subnets(config)
        fast, slow = by_name["mstnn_fast"], by_name["mstnn_slow"]
        self._bottom_up = config.update_order == "bottom_up"
        self._mstnn_fast = _Maps(by_name["vision_input"], fast, _of(fast, parameters))
        self._mstnn_slow = _Maps(fast, slow, _of(slow, parameters))
        pfc = _of(by_name["pfc"], parameters)
        pfc["input"] = _as_seen(pfc["input"], slow)
        self._levels = (
            _Level(by_name["pfc"], pfc),
            *(
                _Level(by_name[name], _of(by_name[name], parameters))
                for name in ("mtrnn_slow", "mtrnn_fast")
            ),
        )
        self._outputs = _of(by_name["outputs"], parameters)
        self._output_shape = by_name["outputs"].shape
        self.reset()

    def reset(self) -> None:
        """Return to the neutral state."""
        self._mstnn_fast.reset()
        self._mstnn_slow.reset()
        for level in self._levels:
            level.reset()
        # V_S, PFC, M_S, M_F, as of the last step
        seen = np.zeros(self._levels[0].weights["input"].shape[1], self._outputs["bias"].dtype)
        self._activity = [seen, *(np.zeros_like(level.potential) for level in self._levels)]

    def step(self, image: Array) -> Array:
        """Outputs (11, softmax units) for the image (height, width) seen now, -1..1."""
        return self.act(self.see(image))

    def see(self, image: Array) -> Array:
        """The first half of a step: activity (units,) of V_S, for each place that of all maps."""
        return self._mstnn_slow.step(self._mstnn_fast.step(image)).ravel()

    def act(self, seen: Array) -> Array:
        """The second half: outputs (11, softmax units) for what `see` returned."""
        before = self._activity
        now = [seen]
        source = now if self._bottom_up else before
        for number, level in enumerate(self._levels):
            below, own, *above = source[number], *before[number + 1 : number + 3]
            now.append(level.step(below, own, *above))
        self._activity = now
        top = source[len(self._levels)]
        return _softmax(
            (self._outputs["input"] @ top + self._outputs["bias"]).reshape(self._output_shape)
        )

    def pfc(self) -> Array:
        """Activity (units,) of the PFC after the last step."""
        return self._levels[0].activity()

    @property
    def activity(self) -> dict[str, Array]:
        """Activity (units,) of each subnet but V_I and M_O after the last step, by name.

        The units of V_F and V_S are ordered by map, row and column.
        """
        pfc, mtrnn_slow, mtrnn_fast = self._levels
        return {
            "mstnn_fast": self._mstnn_fast.activity(),
            "mstnn_slow": self._mstnn_slow.activity(),
            "pfc": pfc.activity(),
            "mtrnn_slow": mtrnn_slow.activity(),
            "mtrnn_fast": mtrnn_fast.activity(),
        }


class _Maps:
    """V_F or V_S; its activity is (height, width x maps): for each place that of all maps."""

    def __init__(self, below: Subnet, subnet: Subnet, weights: dict[str, Array]) -> None:
        maps_below, _, width_below = below.shape
        maps, self._height, width = subnet.shape
        kernel, stride = weights["kernel"], subnet.stride or 1
        self._band = _band(kernel, width_below, width, stride)
        self._bias = np.tile(weights["bias"], width)
        self._row_step = stride * width_below * maps_below
        self._leak = kernel.dtype.type(1 / subnet.tau)
        self._shape = (self._height, width * maps)
        self._maps = maps
        self.reset()

    def reset(self) -> None:
        self._potential = np.zeros(self._shape, self._band.dtype)

    def step(self, below: Array) -> Array:
        stretches = sliding_window_view(below.reshape(-1), len(self._band))[:: self._row_step]
        drive = stretches @ self._band
        drive += self._bias
        drive -= self._potential
        drive *= self._leak
        self._potential += drive
        return _activation(self._potential)

    def activity(self) -> Array:
        by_place = _activation(self._potential).reshape(-1, self._maps)
        return np.ascontiguousarray(by_place.T).reshape(-1)


class _Level:
    """PFC, M_S or M_F."""

    def __init__(self, subnet: Subnet, weights: dict[str, Array]) -> None:
        self.weights = weights
        self._leak = weights["bias"].dtype.type(1 / subnet.tau)
        self.reset()

    def reset(self) -> None:
        self.potential = np.zeros_like(self.weights["bias"])

    def step(self, below: Array, own: Array, above: Array | None = None) -> Array:
        weights = self.weights
        drive = weights["input"] @ below + weights["recurrent"] @ own + weights["bias"]
        if above is not None:
            drive += weights["feedback"] @ above
        self.potential = self.potential + self._leak * (drive - self.potential)
        return self.activity()

    def activity(self) -> Array:
        return _activation(self.potential)


def _of(subnet: Subnet, parameters: Parameters) -> dict[str, Array]:
    return {name: parameters[f"{subnet.name}.{name}"] for name in subnet.parameters}


def _as_seen(weights: Array, slow: Subnet) -> Array:
    """Weights (units, maps x height x width) reordered to (units, height x width x maps)."""
    return np.ascontiguousarray(
        np.moveaxis(weights.reshape(-1, *slow.shape), 1, -1).reshape(len(weights), -1)
    )


def _band(kernel: Array, width_below: int, width: int, stride: int) -> Array:
    """(kernel height x width_below x maps below, width x maps) for one row of units."""
    maps, maps_below, kernel_height, kernel_width = kernel.shape
    band = np.zeros((kernel_height, width_below, maps_below, width, maps), kernel.dtype)
    patch = kernel.transpose(2, 3, 1, 0)
    for column in range(width):
        left = column * stride
        band[:, left : left + kernel_width, :, column] = patch
    return band.reshape(kernel_height * width_below * maps_below, width * maps)


def _activation(potentials: Array) -> Array:
    activity = potentials * potentials.dtype.type(ACTIVATION_SLOPE)
    np.tanh(activity, out=activity)
    activity *= potentials.dtype.type(ACTIVATION_GAIN)
    return activity


def _softmax(potentials: Array) -> Array:
    excitations = np.exp(potentials - potentials.max(-1, keepdims=True))
    return np.asarray(excitations / excitations.sum(-1, keepdims=True))
