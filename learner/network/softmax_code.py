"""The code of M_O: for each analog value a softmax over units with reference values.

A value x excites unit i by exp(-(reference_i - x)^2 / (2 width^2)), normalized over its units. It
is decoded as the mean of the references weighted by the outputs. The references reach beyond the
range of the values by a margin; without it the ends of the range could not be represented.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from proto.body import ACTION_VALUES
from proto.config import NetworkConfig

Values = NDArray[np.float64]

_LOWEST: Final = np.array([value.minimum for value in ACTION_VALUES])
_HIGHEST: Final = np.array([value.maximum for value in ACTION_VALUES])
_NARROWEST_RANGE: Final = 1.0
"""Smallest range of a value, for values that never change (degrees, or levels)."""


@dataclass(frozen=True)
class SoftmaxCode:
    """The code of the eleven action values.

    Attributes:
        minima: (11,) lowest value of each range; lower values are coded as it.
        maxima: (11,) highest value of each range; higher values are coded as it.
        references: (11, softmax units) the value that each unit stands for.
        widths: (11,) standard deviation of the excitation.
    """

    minima: Values
    maxima: Values
    references: Values
    widths: Values

    @classmethod
    def of_ranges(cls, minima: Values, maxima: Values, config: NetworkConfig) -> Self:
        """A code for some ranges.

        Args:
            minima: (11,).
            maxima: (11,).
            config: `code_margin` is the margin at each end as a fraction of the range, `code_width`
                the width of the excitation in spacings of the references.
        """
        minima, maxima = np.asarray(minima, np.float64), np.asarray(maxima, np.float64)
        margins = config.code_margin * (maxima - minima)
        references = np.linspace(minima - margins, maxima + margins, config.softmax_units, axis=-1)
        widths = config.code_width * (references[:, 1] - references[:, 0])
        return cls(minima, maxima, references, widths)

    @classmethod
    def of_actions(cls, actions: NDArray[np.floating], config: NetworkConfig) -> Self:
        """A code for the ranges that actions (..., 11) span."""
        flat = np.asarray(actions, np.float64).reshape(-1, len(ACTION_VALUES))
        minima, maxima = flat.min(0), flat.max(0)
        widening = np.maximum(_NARROWEST_RANGE - (maxima - minima), 0.0) / 2
        return cls.of_ranges(minima - widening, maxima + widening, config)

    def encode(self, actions: NDArray[np.floating]) -> NDArray[np.float32]:
        """Distributions (..., 11, softmax units) for actions (..., 11); each sums to one."""
        inside = np.clip(np.asarray(actions, np.float64), self.minima, self.maxima)
        distances = (inside[..., None] - self.references) / self.widths[:, None]
        excitations = np.exp(-0.5 * distances**2)
        return np.asarray(excitations / excitations.sum(-1, keepdims=True), np.float32)

    def decode(self, outputs: NDArray[np.floating]) -> Values:
        """Actions (..., 11) for outputs (..., 11, softmax units), within what the robot accepts."""
        means = np.vecdot(outputs, self.references)
        return np.asarray(means.clip(_LOWEST, _HIGHEST))
