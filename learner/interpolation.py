"""Sequences between the tutored ones, guessed as lying on a straight line.

Tutored situations are few and lie on a grid; a network that learns them alone treats what it sees
in between as the nearest of them. The behaviour for neighbouring situations has the same phases at
the same steps, and both what is seen and what is to be done change nearly in proportion to the
situation. So a mixture of two neighbours' sequences, of V_S and of the targets alike, tells nearly
what the tutor would do halfway (mixup, Zhang et al. 2018, among neighbours only).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import torch
from torch import Tensor

REACH: Final = 0.1
"""Mixtures reach beyond both neighbours, by this part of their distance.

Without it the outermost situations would be the ends of all lines, and what is learned about them
would be drawn towards the middle.
"""


@dataclass(frozen=True)
class Mixture:
    """Which sequences are mixed: (1 - weight) of the one and weight of its partner.

    Attributes:
        chosen: (B,) indices of the sequences.
        partners: (B,) indices of their partners; itself where there is none.
        weights: (B,) float32.
    """

    chosen: Tensor
    partners: Tensor
    weights: Tensor

    def of(self, values: Tensor) -> Tensor:
        """Mix values (S, ...) of all sequences; (B, ...)."""
        weights = self.weights.view(-1, *[1] * (values.ndim - 1))
        return torch.lerp(values[self.chosen], values[self.partners], weights)


class Neighbours:
    """Sequences of neighbouring situations: those that differ in one value, none in between."""

    def __init__(self, situations: Sequence[Mapping[str, float]], steps: Sequence[int]) -> None:
        """Find the neighbours of each sequence.

        Args:
            situations: that of each sequence.
            steps: number of steps of each; sequences of different lengths are no neighbours.
        """
        shown: dict[_Situation, list[int]] = defaultdict(list)
        for index, (situation, length) in enumerate(zip(situations, steps, strict=True)):
            shown[(*sorted(situation.items()), ("steps", length))].append(index)
        beside = _beside(list(shown))
        self._partners: list[list[list[int]]] = [[] for _ in situations]
        for key, indices in shown.items():
            for index in indices:
                self._partners[index] = [shown[other] for other in beside[key]]

    def mixture(self, chosen: Tensor, share: float, generator: torch.Generator) -> Mixture:
        """Draw a neighbour and a weight for a share of the sequences with these indices."""
        mixed, side, repeat, part = torch.rand(4, len(chosen), generator=generator)
        weights = (part * (1 + 2 * REACH) - REACH).where(mixed < share, torch.zeros(()))
        partners = [
            self._partner(index, *where)
            for index, *where in zip(chosen.tolist(), side.tolist(), repeat.tolist(), strict=True)
        ]
        return Mixture(chosen, torch.tensor(partners), weights)

    def _partner(self, index: int, side: float, repeat: float) -> int:
        """One of its partners; `side` and `repeat`, 0..1, say which. Itself if it has none."""
        around = self._partners[index] or [[index]]
        repeats = around[int(side * len(around))]
        return repeats[int(repeat * len(repeats))]


_Situation = tuple[tuple[str, float], ...]


def _beside(situations: Sequence[_Situation]) -> Mapping[_Situation, list[_Situation]]:
    """The neighbours of each situation."""
    beside: dict[_Situation, list[_Situation]] = defaultdict(list)
    for place in range(max(map(len, situations), default=0) - 1):  # the last is the length
        lines: dict[_Situation, list[_Situation]] = defaultdict(list)
        for situation in situations:
            if place < len(situation):
                lines[situation[:place] + situation[place + 1 :]].append(situation)
        for line in lines.values():
            for one, other in pairwise(sorted(line)):
                beside[one].append(other)
                beside[other].append(one)
    return beside
