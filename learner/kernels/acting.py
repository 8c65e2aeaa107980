"""The whole network one step at a time: one call of C++ to see, one to act (`acting.cpp`)."""

from __future__ import annotations

import ctypes
import math
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from learner.kernels.library import acting_library

Floats = NDArray[np.float32]

_LEVELS: Final = 3
_LARGEST: Final = 2**15
"""Of each size: products of two of them are integers of the library."""


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
        ("levels", _LevelShape * _LEVELS),
        *((name, ctypes.c_int32) for name in ("values", "softmax_units", "literal")),
        ("parameters", ctypes.c_void_p),
    )


@dataclass(frozen=True)
class MapsSizes:
    """V_F or V_S.

    Attributes:
        maps: number of maps.
        height: rows of units in a map.
        width: columns of units in a map.
        kernel_height: rows of the subnet below that one unit sees.
        kernel_width: columns of it.
        stride: shift of the kernel between neighbouring units.
        tau: time constant in control steps.
    """

    maps: int
    height: int
    width: int
    kernel_height: int
    kernel_width: int
    stride: int
    tau: float


@dataclass(frozen=True)
class LevelSizes:
    """PFC, M_S or M_F: number of units, and time constant in control steps."""

    units: int
    tau: float


@dataclass(frozen=True)
class NetworkSizes:
    """The whole network.

    Attributes:
        image: (height, width) of the image.
        maps: V_F and V_S.
        levels: PFC, M_S and M_F.
        values: values of an action.
        softmax_units: units of M_O for each value.
        literal: every connection of the levels takes one step, as eq. (1) is printed.
    """

    image: tuple[int, int]
    maps: tuple[MapsSizes, MapsSizes]
    levels: tuple[LevelSizes, LevelSizes, LevelSizes]
    values: int
    softmax_units: int
    literal: bool


class ActingKernel:
    """A network in C++ with its state.

    `see` computes `seen` from `image`, and `act` computes `outputs` from `seen`; each starts from
    the state after the call before. The caller writes and reads the three arrays in place.

    Attributes:
        image: (height, width) float32, brightness -1..1.
        seen: (V_S units,) float32, activity of V_S.
        outputs: (values, softmax units) float32.
        pfc: (PFC units,) float32, activity of the PFC; `look_at_pfc` writes it.
        reset: returns to the neutral state.
        see: computes `seen`.
        act: computes `outputs`.
        look_at_pfc: writes the activity after the last call of `act` into `pfc`.
    """

    def __init__(self, sizes: NetworkSizes, parameters: Sequence[Floats]) -> None:
        """Make a network in its neutral state.

        Args:
            sizes: its sizes.
            parameters: kernel and bias of V_F and V_S; input, recurrent, feedback (not of M_F) and
                bias of each level; input and bias of the outputs. They are copied.

        Raises:
            RuntimeError: the library is not compiled here.
            ValueError: the parameters do not have the sizes.
            MemoryError: there is not enough memory.
        """
        library = acting_library()
        if library is None:
            raise RuntimeError("the kernels are not compiled here")
        network = _make(library, sizes, parameters)
        weakref.finalize(self, library.vmdnn_acting_free, network)
        slow = sizes.maps[1]
        self.image = np.zeros(sizes.image, np.float32)
        self.seen = np.zeros(slow.maps * slow.height * slow.width, np.float32)
        self.outputs = np.zeros((sizes.values, sizes.softmax_units), np.float32)
        self.pfc = np.zeros(sizes.levels[0].units, np.float32)
        image, seen, outputs, pfc = (
            array.ctypes.data for array in (self.image, self.seen, self.outputs, self.pfc)
        )
        self.reset = partial(library.vmdnn_acting_reset, network)
        self.see = partial(library.vmdnn_acting_see, network, image, seen)
        self.act = partial(library.vmdnn_acting_act, network, seen, outputs)
        self.look_at_pfc = partial(library.vmdnn_acting_pfc, network, pfc)


def available() -> bool:
    """Whether the library is compiled here; logs which, once."""
    return acting_library() is not None


def _make(library: ctypes.PyDLL, sizes: NetworkSizes, parameters: Sequence[Floats]) -> int:
    """A new network of the library.

    Raises:
        ValueError: the sizes are not those of a network, or the parameters do not have them.
        MemoryError: there is not enough memory.
    """
    _check(sizes)
    flat = np.concatenate([np.asarray(each, np.float32).reshape(-1) for each in parameters])
    if len(flat) != _parameter_count(sizes):  # the library follows the sizes without checking them
        raise ValueError(f"there are {len(flat)} parameters, not {_parameter_count(sizes)}")
    height, width = sizes.image
    description = _Description(
        image_height=height,
        image_width=width,
        maps=tuple(_maps_shape(maps) for maps in sizes.maps),
        levels=tuple(_LevelShape(level.units, 1 / level.tau) for level in sizes.levels),
        values=sizes.values,
        softmax_units=sizes.softmax_units,
        literal=sizes.literal,
        parameters=flat.ctypes.data,
    )
    network: int | None = library.vmdnn_acting_new(ctypes.byref(description))
    if network is None:
        raise MemoryError("there is no memory for the network")
    return network


def _check(sizes: NetworkSizes) -> None:
    """The library follows the sizes without checking them."""
    below = sizes.image
    for maps in sizes.maps:
        kernel = (maps.kernel_height, maps.kernel_width)
        counts = (maps.maps, maps.stride, *kernel, *below)
        if not all(1 <= count <= _LARGEST for count in counts):
            raise ValueError(f"{maps} has a size that is not in 1..{_LARGEST}")
        rows_and_columns = tuple(
            (size - taps) // maps.stride + 1 for size, taps in zip(below, kernel, strict=True)
        )
        if min(rows_and_columns) < 1 or rows_and_columns != (maps.height, maps.width):
            raise ValueError(f"{maps} does not fit what it sees, which is {below}")
        below = (maps.height, maps.width)
    widths = (*(level.units for level in sizes.levels), sizes.values, sizes.softmax_units)
    if not all(1 <= width <= _LARGEST for width in widths):
        raise ValueError(f"{sizes} has a size that is not in 1..{_LARGEST}")
    taus = [each.tau for each in (*sizes.maps, *sizes.levels)]
    if not all(1 <= tau < math.inf for tau in taus):
        raise ValueError(f"the time constants {taus} are not all finite and at least 1")
    if _parameter_count(sizes) >= 2**31:
        raise ValueError(f"{_parameter_count(sizes)} parameters are too many")


def _maps_shape(maps: MapsSizes) -> _MapsShape:
    return _MapsShape(
        maps.maps,
        maps.height,
        maps.width,
        maps.kernel_height,
        maps.kernel_width,
        maps.stride,
        1 / maps.tau,
    )


def _parameter_count(sizes: NetworkSizes) -> int:
    count, maps_below = 0, 1
    for maps in sizes.maps:
        count += maps.maps * (maps_below * maps.kernel_height * maps.kernel_width + 1)
        maps_below = maps.maps
    below = maps_below * sizes.maps[1].height * sizes.maps[1].width
    for level, above in zip(sizes.levels, (*sizes.levels[1:], None), strict=True):
        sources = below + level.units + (0 if above is None else above.units)
        count += level.units * (sources + 1)
        below = level.units
    return count + sizes.values * sizes.softmax_units * (below + 1)
