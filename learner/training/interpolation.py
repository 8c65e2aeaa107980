"""Sequences between the tutored ones, interpolated from their neighbours.

Tutored situations are few and lie on a grid. A network that learns only these treats a situation
between them as the nearest one. The tutor's behaviour has the same phases at the same steps in all
situations, and both what is seen and what is done change almost linearly with the situation. So a
weighted mean of the sequences at the corners of a grid cell, of V_S and of the targets alike, is
close to what the tutor would show inside the cell (mixup, Zhang et al. 2018, within cells).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import prod
from typing import Final, NamedTuple

import torch
from torch import Tensor

from learner.kernels import mixing as kernel
from learner.network.softmax_code import SoftmaxCode
from learner.training.sequences import Sequences
from proto.variables import Situation

OVERSHOOT: Final = 0.1
"""Points are drawn up to this fraction of a cell's width beyond its sides.

Otherwise the outermost situations would lie at the edge of everything that is learned, and what
the network learns for them would be pulled towards the middle of the grid.
"""


@dataclass(frozen=True)
class Mixtures:
    """B weighted means of sequences.

    Attributes:
        members: (B, corners of a cell) int64, indices of sequences.
        weights: (B, corners of a cell); those of a mixture sum to one.
    """

    members: Tensor
    weights: Tensor

    def of(self, values: Tensor) -> Tensor:
        """Mix values (S, ...) of all sequences; (B, ...)."""
        return torch.einsum("bk,bk...->b...", self.weights.to(values.dtype), values[self.members])


class NeighbourGrid:
    """The grid on which the situations of some sequences lie, and its cells.

    A dimension of the grid is a continuous value of the situation. Two situations are neighbours if
    they differ in one continuous value only and no other situation lies between them. A value that
    is text is a discrete choice: sequences are mixed only if their discrete values agree, and their
    lengths. A situation without neighbours is never mixed, nor is one that is not known (empty).
    Distractors, on which the actions do not depend, count for nothing here: situations that differ
    in them alone lie at the same point.
    """

    def __init__(
        self,
        situations: Sequence[Situation],
        steps: Sequence[int],
        distractors: Collection[str] = (),
    ) -> None:
        """Find the cells.

        Args:
            situations: situation of each sequence; those with other names are never neighbours.
            steps: number of steps of each sequence.
            distractors: names of values that the actions do not depend on.
        """
        relevant = [
            {name: value for name, value in situation.items() if name not in distractors}
            for situation in situations
        ]
        self._points = [
            _point(situation, length) for situation, length in zip(relevant, steps, strict=True)
        ]
        for index, situation in enumerate(situations):
            if not situation:  # not known: nothing can be said about its neighbours
                self._points[index] = _Point((), (index,))
        self._sequences_at: dict[_Point, list[int]] = defaultdict(list)
        for index, point in enumerate(self._points):
            self._sequences_at[point].append(index)
        self._dimensions = max(len(point.values) for point in self._points)
        neighbours = [
            _neighbours(self._sequences_at, dimension) for dimension in range(self._dimensions)
        ]
        self._cells = {point: _cells_at(point, neighbours) for point in self._sequences_at}

    def mixtures(self, chosen: Tensor, share: float, generator: torch.Generator) -> Mixtures:
        """Draw a mixture for each of some sequences, at a random point of a cell around it.

        Args:
            chosen: (B,) indices of the sequences.
            share: fraction of them that is mixed; the others keep weight one.
            generator: draws which are mixed, the cells, the points, and the sequence at each corner
                where several share a situation.
        """
        count = len(chosen)
        mixed, cells = torch.rand(2, count, generator=generator)
        positions = torch.rand(self._dimensions, count, generator=generator)
        positions = (positions * (1 + 2 * OVERSHOOT) - OVERSHOOT) * (mixed < share)
        corners = product(*((1 - position, position) for position in positions))
        weights = torch.stack([prod(factors, start=torch.ones(count)) for factors in corners], 1)
        repeats = torch.rand(weights.shape, generator=generator)
        members = [
            self._members(*drawn)
            for drawn in zip(chosen.tolist(), cells.tolist(), repeats.tolist(), strict=True)
        ]
        return Mixtures(torch.tensor(members), weights)

    def _members(self, index: int, cell: float, repeats: Sequence[float]) -> list[int]:
        """A sequence, then one for each other corner of one of its cells.

        Args:
            index: the sequence.
            cell: 0..1, selects the cell.
            repeats: 0..1 for each corner, selects one of the sequences there.
        """
        cells = self._cells[self._points[index]]
        _, *others = cells[int(cell * len(cells))]
        members = [index]
        for corner, repeat in zip(others, repeats[1:], strict=True):
            candidates = self._sequences_at[corner]
            members.append(candidates[int(repeat * len(candidates))])
        return members


def mix_sequences(
    mixtures: Mixtures, sequences: Sequences, targets: Tensor, code: SoftmaxCode
) -> Sequences:
    """The mixtures as sequences.

    Args:
        mixtures: what is mixed.
        sequences: all S sequences.
        targets: (S, T, 11) their actions; the mixed actions are coded, not the codes mixed.
        code: how actions are coded.
    """
    mask = sequences.mask[mixtures.members[:, 0]]
    if kernel.supports(sequences.seen):
        mixed = kernel.mix(mixtures.members, mixtures.weights, sequences.seen, targets, code)
        return Sequences(mixed.seen, mixed.codes, mask, mixed.code_entropies)
    codes = code.encode(mixtures.of(targets).numpy())
    return Sequences.of(mixtures.of(sequences.seen), torch.from_numpy(codes), mask)


class _Point(NamedTuple):
    """A situation on the grid.

    Attributes:
        values: its continuous values, ordered by name.
        group: discrete values, names of the continuous values, and number of steps; cells lie
            within a group.
    """

    values: tuple[float, ...]
    group: tuple[object, ...]

    def moved(self, dimension: int, value: float) -> _Point:
        """The point with another value in one dimension."""
        values = (*self.values[:dimension], value, *self.values[dimension + 1 :])
        return _Point(values, self.group)


def _point(situation: Mapping[str, float | str], steps: int) -> _Point:
    values: list[float] = []
    group: list[object] = [steps]
    for name, value in sorted(situation.items()):
        if isinstance(value, str):
            group.append((name, value))
        else:
            values.append(value)
            group.append(name)
    return _Point(tuple(values), tuple(group))


def _neighbours(points: Mapping[_Point, object], dimension: int) -> Mapping[_Point, list[_Point]]:
    """The neighbours of each point along a dimension."""
    lines: dict[_Point, list[_Point]] = defaultdict(list)
    for point in points:
        if dimension < len(point.values):
            lines[point.moved(dimension, 0.0)].append(point)
    neighbours: dict[_Point, list[_Point]] = {point: [] for point in points}
    for line in lines.values():
        for one, other in pairwise(sorted(line, key=lambda point: point.values[dimension])):
            neighbours[one].append(other)
            neighbours[other].append(one)
    return neighbours


def _cells_at(
    point: _Point, neighbours: Sequence[Mapping[_Point, list[_Point]]]
) -> list[list[_Point]]:
    """The corners of each cell at a point; the point is the first, the last dimension runs fastest.

    A cell is flat in a dimension in which the point has no neighbour or a corner is missing.
    """
    cells = [[point]]
    for dimension in range(len(neighbours)):
        cells = [
            [corner for pair in zip(cell, moved, strict=True) for corner in pair]
            for cell in cells
            for moved in _moved_cells(cell, neighbours[dimension], dimension)
        ]
    return cells


def _moved_cells(
    cell: Sequence[_Point], neighbours: Mapping[_Point, list[_Point]], dimension: int
) -> list[Sequence[_Point]]:
    """A cell moved to each neighbour along a dimension; unmoved where it cannot be moved."""
    moved_cells: list[Sequence[_Point]] = []
    for neighbour in neighbours[cell[0]]:
        moved = [corner.moved(dimension, neighbour.values[dimension]) for corner in cell]
        if all(corner in neighbours for corner in moved):
            moved_cells.append(moved)
    return moved_cells or [cell]
