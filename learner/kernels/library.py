"""Loading the compiled library and finding its functions."""

from __future__ import annotations

import ctypes
import functools
import logging
from collections.abc import Sequence
from typing import Any, Final, TypeVar

import torch
from torch import Tensor

from learner.kernels.build import NotCompiledError, find_or_compile
from proto.errors import UserError

_log = logging.getLogger(__name__)

_Library = TypeVar("_Library", bound=ctypes.CDLL)
_TYPES: Final = {torch.float32: "float", torch.float64: "double"}


@functools.cache
def learning_library() -> ctypes.CDLL | None:
    """The library for learning, or None where it cannot be compiled; logs which, once."""
    library = _load(ctypes.CDLL, "learning", "PyTorch")
    if library is not None:
        library.vmdnn_peak_flops.restype = ctypes.c_double
    return library


@functools.cache
def acting_library() -> ctypes.PyDLL | None:
    """The library for acting, or None where it cannot be compiled; logs which, once.

    Its calls keep Python's global lock: a call takes less time than getting the lock back.
    """
    library = _load(ctypes.PyDLL, "acting", "numpy")
    if library is None:
        return None
    pointer = ctypes.c_void_p
    library.vmdnn_acting_new.restype = pointer
    for name, arguments in (("free", 1), ("reset", 1), ("see", 3), ("act", 3), ("pfc", 2)):
        function = getattr(library, f"vmdnn_acting_{name}")
        function.argtypes, function.restype = (pointer,) * arguments, None
    return library


class TypedKernel:
    """A function of the learning library that exists for float32 and for float64."""

    def __init__(self, name: str, arguments: Sequence[Any], result: Any = None) -> None:
        """Describe the function; the library is loaded at the first use.

        Args:
            name: name of the C function without its ending `_float` or `_double`.
            arguments: ctypes types of its arguments.
            result: ctypes type of its result, or None.
        """
        self._name = name
        self._arguments = tuple(arguments)
        self._result = result
        self._functions: dict[torch.dtype, Any] = {}

    def supports(self, tensor: Tensor) -> bool:
        """Whether the function can compute on this tensor, given its device and type."""
        compiled = learning_library() is not None
        return compiled and tensor.device.type == "cpu" and tensor.dtype in _TYPES

    def __call__(self, dtype: torch.dtype, *arguments: Any) -> Any:
        """Call the function for this type of numbers."""
        if dtype not in self._functions:
            function = getattr(learning_library(), f"{self._name}_{_TYPES[dtype]}")
            function.argtypes, function.restype = self._arguments, self._result
            self._functions[dtype] = function
        return self._functions[dtype](*arguments)


def peak_flops(threads: int) -> float:
    """Floating point operations per second of multiply-adds on registers alone.

    Raises:
        UserError: the library cannot be compiled.
    """
    library = learning_library()
    if library is None:
        raise UserError("the kernels are not compiled here: install a C++ compiler, such as g++")
    return float(library.vmdnn_peak_flops(threads))


def _load(kind: type[_Library], purpose: str, substitute: str) -> _Library | None:
    try:
        path = find_or_compile()
        library = kind(str(path))
    except (NotCompiledError, OSError) as error:
        _log.warning(
            "%s: in %s, several times slower than compiled: %s", purpose, substitute, error
        )
        return None
    _log.info("%s: compiled C++ (%s)", purpose, path)
    return library
