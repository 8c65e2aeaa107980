"""Arrays of a checkpoint as PyTorch tensors, and back."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def to_tensors(arrays: Mapping[str, NDArray[np.generic]]) -> dict[str, Tensor]:
    """Copies of arrays as tensors."""
    return {name: torch.tensor(array) for name, array in arrays.items()}


def to_arrays(tensors: Mapping[str, Tensor]) -> dict[str, NDArray[np.generic]]:
    """Tensors as arrays that share their memory."""
    return {name: tensor.numpy() for name, tensor in tensors.items()}


def prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors with a prefix before each name; `Checkpoint.part` reads them back."""
    return {f"{prefix}{name}": tensor for name, tensor in tensors.items()}
