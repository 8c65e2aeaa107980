"""The network that acts, compiled: one call of C++ for what it sees, one for what it does.

It computes in float32 what `learner.network.numpy_network` says in numpy. See `acting.cpp` for how.
"""

from __future__ import annotations

import ctypes
import logging
import weakref
from collections.abc import Mapping
from functools import cache, partial
from math import prod
from typing import Final

import numpy as np
from numpy.typing import NDArray

from learner.kernels.build import NotCompiledError, find_or_compile
from learner.network.subnets import Subnet, parameter_shapes, subnets
from proto.config import NetworkConfig

Array = NDArray[np.floating]
Floats = NDArray[np.float32]

_LEVELS: Final = ("pfc", "mtrnn_slow", "mtrnn_fast")
_log = logging.getLogger(__name__)


class _MapsShape(ctypes.Structure):
    """`MapsShape` of acting.cpp."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in ("maps", "height", "width")),
        *((name, ctypes.c_int32) for name in ("kernel_height", "kernel_width", "stride")),
        ("leak", ctypes.c_float),
    )


class _LevelShape(ctypes.Structure):
    """`LevelShape` of acting.cpp."""

    _fields_ = (("units", ctypes.c_int32), ("leak", ctypes.c_float))


class _Description(ctypes.Structure):
    """`Description` of acting.cpp."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in ("image_height", "image_width")),
        ("maps", _MapsShape * 2),
        ("levels", _LevelShape * len(_LEVELS)),
        *((name, ctypes.c_int32) for name in ("values", "softmax_units", "literal")),
        ("parameters", ctypes.c_void_p),
    )


def available() -> bool:
    """Whether networks can be compiled ones here; says so once."""
    return _library() is not None


class CompiledNetwork:
    """A network in C++ with the interface and, to float32, the numbers of `NumpyNetwork`.

    Args:
        config: the network's sizes.
        parameters: arrays by name, shaped as `parameter_shapes(config)`.

    Raises:
        RuntimeError: it is not `available` here.
    """

    def __init__(self, config: NetworkConfig, parameters: Mapping[str, Array]) -> None:
        library = _library()
        if library is None:
            raise RuntimeError("there is no compiled library")
        by_name = subnets(config)
        network = _make(library, config, by_name, parameters)
        weakref.finalize(self, library.vmdnn_acting_free, network)
        _, height, width = by_name["vision_input"].shape
        self._image = np.zeros((height, width), np.float32)
        self._seen = np.zeros(prod(by_name["mstnn_slow"].shape), np.float32)
        self._outputs = np.zeros(by_name["outputs"].shape, np.float32)
        image, seen, outputs = (
            array.ctypes.data for array in (self._image, self._seen, self._outputs)
        )
        self._reset = partial(library.vmdnn_acting_reset, network)
        self._see = partial(library.vmdnn_acting_see, network, image, seen)
        self._act = partial(library.vmdnn_acting_act, network, seen, outputs)

    def reset(self) -> None:
        """Return to the neutral state."""
        self._reset()

    def step(self, image: Array) -> Array:
        """Outputs (11, softmax units) for the image (height, width) seen now, -1..1."""
        np.copyto(self._image, image)
        self._see()
        self._act()
        return self._outputs.copy()

    def see(self, image: Array) -> Array:
        """The first half of a step: activity (units,) of V_S."""
        np.copyto(self._image, image)
        self._see()
        return self._seen.copy()

    def act(self, seen: Array) -> Array:
        """The second half: outputs for what `see` returned."""
        np.copyto(self._seen, seen)
        self._act()
        return self._outputs.copy()


def _make(
    library: ctypes.PyDLL,
    config: NetworkConfig,
    by_name: Mapping[str, Subnet],
    parameters: Mapping[str, Array],
) -> int:
    """A new network of the library."""
    _, height, width = by_name["vision_input"].shape
    values, softmax_units = by_name["outputs"].shape
    in_one_row = _in_one_row(config, parameters)
    description = _Description(
        image_height=height,
        image_width=width,
        maps=(_maps_shape(by_name["mstnn_fast"]), _maps_shape(by_name["mstnn_slow"])),
        levels=tuple(_level_shape(by_name[name]) for name in _LEVELS),
        values=values,
        softmax_units=softmax_units,
        literal=config.update_order == "literal",
        parameters=in_one_row.ctypes.data,
    )
    network: int | None = library.vmdnn_acting_new(ctypes.byref(description))
    if network is None:
        raise MemoryError("there is no memory for the network")
    return network


def _maps_shape(subnet: Subnet) -> _MapsShape:
    kernel_height, kernel_width = subnet.parameters["kernel"][2:]
    return _MapsShape(*subnet.shape, kernel_height, kernel_width, subnet.stride, 1 / subnet.tau)


def _level_shape(subnet: Subnet) -> _LevelShape:
    return _LevelShape(*subnet.shape, 1 / subnet.tau)


def _in_one_row(config: NetworkConfig, parameters: Mapping[str, Array]) -> Floats:
    """All parameters, one after the other; the library follows the sizes without looking."""
    row = []
    for name, shape in parameter_shapes(config).items():
        if parameters[name].shape != shape:
            raise ValueError(f"{name} is {parameters[name].shape}, but must be {shape}")
        row.append(np.asarray(parameters[name], np.float32).reshape(-1))
    return np.concatenate(row)


@cache
def _library() -> ctypes.PyDLL | None:
    """The compiled library, if there is one; says once whether.

    Its calls are too short to let other threads run meanwhile: getting the turn back could take
    longer than the call.
    """
    try:
        path = find_or_compile()
        library = ctypes.PyDLL(str(path))
    except (NotCompiledError, OSError) as error:
        _log.warning("acting: in numpy, several times slower than compiled: %s", error)
        return None
    _log.info("acting: compiled C++ (%s)", path)
    pointer = ctypes.c_void_p
    library.vmdnn_acting_new.restype = pointer
    for name, arguments in (("free", 1), ("reset", 1), ("see", 3), ("act", 3)):
        function = getattr(library, f"vmdnn_acting_{name}")
        function.argtypes, function.restype = (pointer,) * arguments, None
    return library
