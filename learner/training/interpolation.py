"""Sequences between the tutored ones, guessed from those around them.

Tutored situations are few and lie on a grid; a network that learns them alone treats what it sees
in between as the nearest of them. The behaviour has the same phases at the same steps everywhere,
and both what is seen and what is to be done change nearly in proportion to the situation. So a
mixture of the sequences at the corners of a cell of the grid, of V_S and of the targets alike,
tells nearly what the tutor would show somewhere inside (mixup, Zhang et al. 2018, within cells).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import prod
from typing import Any, Final

import torch
from torch import Tensor

from learner.kernels import mixing as kernel
from learner.network.softmax_code import SoftmaxCode
from learner.training.sequences import Sequences

REACH: Final = 0.1
"""Points are drawn up to this part of a cell's width beyond its sides.

Else the outermost situations would be at the end of all that is learned about, and what is learned
there would be drawn towards the middle.
"""


@dataclass(frozen=True)
class Mixtures:
    """Which sequences are mixed, and how much of each.

    Attributes:
        members: (B, corners of a cell) int64, indices of sequences.
        weights: (B, corners of a cell); those of a mixture sum to one.
    """

    members: Tensor
    weights: Tensor

    def of(self, values: Tensor) -> Tensor:
        """Mix values (S, ...) of all sequences; (B, ...)."""
        return torch.einsum("bk,bk...->b...", self.weights.to(values.dtype), values[self.members])


class Cells:
    """The cells of the grid that some sequences' situations make.

    Situations are neighbours if they differ in one value and none of the others lies between. A
    situation off the grid has no neighbours, and its sequences are mixed with nothing else.
    """

    def __init__(self, situations: Sequence[Mapping[str, Any]], steps: Sequence[int]) -> None:
        """Find the cells.

        Args:
            situations: that of each sequence; all with the same values.
            steps: number of steps of each; sequences of different lengths are not mixed.
        """
        self._places = [
            (*(value for _, value in sorted(situation.items())), length)
            for situation, length in zip(situations, steps, strict=True)
        ]
        self._shown: dict[_Place, list[int]] = defaultdict(list)
        for index, place in enumerate(self._places):
            self._shown[place].append(index)
        self._dimensions = len(self._places[0]) - 1
        beside = [_beside(self._shown, dimension) for dimension in range(self._dimensions)]
        self._cells = {place: _cells_at(place, beside) for place in self._shown}

    def mixtures(self, chosen: Tensor, share: float, generator: torch.Generator) -> Mixtures:
        """Draw a point in a cell around a share of the sequences with these indices.

        The rest stay as they are.
        """
        count = len(chosen)
        mixed, cells = torch.rand(2, count, generator=generator)
        parts = torch.rand(self._dimensions, count, generator=generator)
        parts = (parts * (1 + 2 * REACH) - REACH) * (mixed < share)
        corners = product(*((1 - part, part) for part in parts))
        weights = torch.stack([prod(factors, start=torch.ones(count)) for factors in corners], 1)
        repeats = torch.rand(weights.shape, generator=generator)
        members = [
            self._members(*drawn)
            for drawn in zip(chosen.tolist(), cells.tolist(), repeats.tolist(), strict=True)
        ]
        return Mixtures(torch.tensor(members), weights)

    def _members(self, index: int, cell: float, repeats: Sequence[float]) -> list[int]:
        """A sequence and, for each other corner of one of its cells, one; 0..1 say which."""
        around = self._cells[self._places[index]]
        _, *others = around[int(cell * len(around))]
        members = [index]
        for corner, repeat in zip(others, repeats[1:], strict=True):
            shown = self._shown[corner]
            members.append(shown[int(repeat * len(shown))])
        return members


def mixed(
    mixtures: Mixtures, sequences: Sequences, targets: Tensor, code: SoftmaxCode
) -> Sequences:
    """The sequences that mixtures of some sequences with targets (S, T, 11) are."""
    mask = sequences.mask[mixtures.members[:, 0]]
    if kernel.serves(sequences):
        return kernel.mixed(mixtures.members, mixtures.weights, sequences, targets, code, mask)
    codes = code.encode(mixtures.of(targets).numpy())
    return Sequences.of(mixtures.of(sequences.seen), torch.from_numpy(codes), mask)


_Place = tuple[float, ...]
"""A situation's values, and the number of steps."""


def _beside(places: Mapping[_Place, object], dimension: int) -> Mapping[_Place, list[_Place]]:
    """The neighbours of each place along a dimension."""
    lines: dict[_Place, list[_Place]] = defaultdict(list)
    for place in places:
        lines[place[:dimension] + place[dimension + 1 :]].append(place)
    beside: dict[_Place, list[_Place]] = {place: [] for place in places}
    for line in lines.values():
        for one, other in pairwise(sorted(line)):
            beside[one].append(other)
            beside[other].append(one)
    return beside


def _cells_at(place: _Place, beside: Sequence[Mapping[_Place, list[_Place]]]) -> list[list[_Place]]:
    """The corners of each cell at a place, which comes first; the last dimension changes fastest.

    A cell is flat in a dimension in which the place or a corner has no neighbour.
    """
    cells = [[place]]
    for dimension in range(len(beside)):
        cells = [
            [corner for pair in zip(cell, moved, strict=True) for corner in pair]
            for cell in cells
            for moved in _moved(cell, beside[dimension], dimension)
        ]
    return cells


def _moved(
    cell: Sequence[_Place], beside: Mapping[_Place, list[_Place]], dimension: int
) -> list[Sequence[_Place]]:
    """A cell's corners moved to each side of a dimension; where they are if they cannot be."""
    ways: list[Sequence[_Place]] = []
    for neighbour in beside[cell[0]]:
        there = [
            (*corner[:dimension], neighbour[dimension], *corner[dimension + 1 :]) for corner in cell
        ]
        if all(corner in beside for corner in there):
            ways.append(there)
    return ways or [cell]
