"""Loading the compiled library.

Without PyTorch, which takes seconds to import: an actor does without it.
"""

from __future__ import annotations

import ctypes
import functools
import logging
from typing import TypeVar

from learner.kernels.build import NotCompiledError, find_or_compile
from proto.errors import UserError

_log = logging.getLogger(__name__)

_Library = TypeVar("_Library", bound=ctypes.CDLL)


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
