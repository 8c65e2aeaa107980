"""The compiled library, for learning."""

from __future__ import annotations

import ctypes
import functools
import logging

from learner.kernels.build import NotCompiledError, find_or_compile
from proto.errors import UserError

_log = logging.getLogger(__name__)


@functools.cache
def learning_library() -> ctypes.CDLL | None:
    """The library, if it is or can be compiled; says once whether."""
    try:
        path = find_or_compile()
        library = ctypes.CDLL(str(path))
    except (NotCompiledError, OSError) as error:
        _log.warning("learning: in PyTorch, several times slower than compiled: %s", error)
        return None
    _log.info("learning: compiled C++ (%s)", path)
    library.vmdnn_peak_flops.restype = ctypes.c_double
    return library


def peak_flops(threads: int) -> float:
    """Floating point operations per second of multiply-adds on registers alone.

    Raises:
        UserError: there is no compiled library, and so no such loop.
    """
    library = learning_library()
    if library is None:
        raise UserError("the kernels are not compiled here: install a C++ compiler, such as g++")
    return float(library.vmdnn_peak_flops(threads))
