"""The two main components of states (principal component analysis)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Components:
    """The two main components of states.

    Attributes:
        mean: (units,) mean of all states.
        axes: (2, units) directions of the components, orthonormal. The largest entry of each is
            positive.
        explained: (2,) share of the variance along each.
    """

    mean: Array
    axes: Array
    explained: Array

    @classmethod
    def of(cls, states: Array) -> Components:
        """Compute the components of states (N, units)."""
        mean = states.mean(axis=0)
        _, sizes, directions = np.linalg.svd(states - mean, full_matrices=False)
        axes = directions[:2]
        largest = np.abs(axes).argmax(axis=1)
        signs = np.sign(axes[np.arange(2), largest])
        total = np.square(sizes).sum() or 1.0  # states that never change have no variance
        return cls(mean, axes * signs[:, None], np.square(sizes[:2]) / total)

    def project(self, states: Array) -> Array:
        """Project states (T, units) onto the components; (T, 2)."""
        return (states - self.mean) @ self.axes.T
