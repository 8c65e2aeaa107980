"""Functions of the learning library on PyTorch's tensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import torch
from torch import Tensor

from learner.kernels.library import learning_library

_TYPES: Final = {torch.float32: "float", torch.float64: "double"}


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
