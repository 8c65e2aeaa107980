"""Sequences between the tutored ones, interpolated from their neighbours.

Tutored situations are few and lie on a grid. A network that learns only these treats a situation
between them as the nearest one. The tutor's behaviour has the same phases at the same steps in all
situations, and both what is seen and what is done change almost linearly with the situation. So a
weighted mean of the sequences at the corners of a grid cell is close to what the tutor would show
inside the cell (mixup, Zhang et al. 2018, within cells). What is done changes so smoothly that a
parabola through three tutored values is closer still; for V_S it is not.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from learner.kernels import mixing as kernel
from learner.network.softmax_code import SoftmaxCode
from learner.training.sequences import Sequences
from proto.variables import Situation

OVERSHOOT: Final = 0.1
"""Points are drawn up to this fraction of a cell's width beyond its sides.

Otherwise the outermost situations would lie at the edge of everything that is learned, and what
the network learns for them would be pulled towards the middle of the grid.
"""

LEAST_CLOSENESS: Final = -2.0
LARGEST_CLOSENESS: Final = 2 / 3
"""Limits of `_Cell.closeness`: a third point nearer to the cell than half its width is not used.

Through points so close together a parabola would exaggerate small differences between sequences.
"""


@dataclass(frozen=True)
class Mixtures:
    """B weighted means of sequences.

    The members of each are the corners of a cell, then one sequence beyond it for each dimension.

    Attributes:
        members: (B, corners + dimensions) int64, indices of sequences.
        weights: (B, corners + dimensions) for V_S: linear in each dimension, so zero beyond the
            cell; those of a mixture sum to one.
        target_weights: (B, corners + dimensions) for the actions: parabolas; they sum to one, too.
    """

    members: Tensor
    weights: Tensor
    target_weights: Tensor

    def seen(self, values: Tensor) -> Tensor:
        """Mix the activity of V_S (S, ...) of all sequences; (B, ...)."""
        return _weighted(self.weights, values[self.members])

    def targets(self, values: Tensor) -> Tensor:
        """Mix the actions (S, ...) of all sequences; (B, ...)."""
        return _weighted(self.target_weights, values[self.members])


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
        points = [
            _point(situation, length) for situation, length in zip(relevant, steps, strict=True)
        ]
        for index, situation in enumerate(situations):
            if not situation:  # not known: nothing can be said about its neighbours
                points[index] = _Point((), (index,))
        sequences_at: dict[_Point, list[int]] = defaultdict(list)
        for index, point in enumerate(points):
            sequences_at[point].append(index)
        self._dimensions = max(len(point.values) for point in points)
        neighbours = [_neighbours(sequences_at, each) for each in range(self._dimensions)]
        numbers = {point: number for number, point in enumerate(sequences_at)}
        cells = [_cells_at(point, neighbours) for point in sequences_at]
        self._points = torch.tensor([numbers[point] for point in points])
        self._cell_counts = torch.tensor(list(map(len, cells)))
        self._first_cells = self._cell_counts.cumsum(0) - self._cell_counts
        self._members_of_cells = torch.tensor(
            [[numbers[point] for point in cell.points] for each in cells for cell in each]
        )
        self._closeness = torch.tensor([cell.closeness for each in cells for cell in each])
        self._sequence_counts = torch.tensor(list(map(len, sequences_at.values())))
        self._sequences_at = pad_sequence(
            [torch.tensor(each) for each in sequences_at.values()], batch_first=True
        )

    def mixtures(self, chosen: Tensor, share: float, generator: torch.Generator) -> Mixtures:
        """Draw a mixture for each of some sequences, at a random point of a cell around it.

        Args:
            chosen: (B,) indices of the sequences.
            share: fraction of them that is mixed; the others keep weight one.
            generator: draws which are mixed, the cells, the points, and the sequence of each member
                where several share a situation.
        """
        count = len(chosen)
        mixed, drawn = torch.rand(2, count, generator=generator)
        positions = torch.rand(count, self._dimensions, generator=generator)
        positions = (positions * (1 + 2 * OVERSHOOT) - OVERSHOOT) * (mixed < share)[:, None]
        points = self._points[chosen]
        cells = self._first_cells[points] + _index(drawn, self._cell_counts[points])
        corners = self._members_of_cells[cells]
        repeats = torch.rand(corners.shape, generator=generator)
        members = self._sequences_at[corners, _index(repeats, self._sequence_counts[corners])]
        members[:, 0] = chosen
        # Numpy: PyTorch takes several times as long for arrays as small as these.
        weights = _linear_weights(positions.numpy())
        bends = _bends(positions.numpy(), self._closeness[cells].numpy())
        return Mixtures(members, torch.from_numpy(weights), torch.from_numpy(weights + bends))


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
        mixed = kernel.mix(
            mixtures.members,
            mixtures.weights,
            mixtures.target_weights,
            sequences.seen,
            targets,
            code,
        )
        return Sequences(mixed.seen, mixed.codes, mask, mixed.code_entropies)
    codes = code.encode(mixtures.targets(targets).numpy())
    return Sequences.of(mixtures.seen(sequences.seen), torch.from_numpy(codes), mask)


def _weighted(weights: Tensor, values: Tensor) -> Tensor:
    return torch.einsum("bk,bk...->b...", weights.to(values.dtype), values)


def _index(drawn: Tensor, counts: Tensor) -> Tensor:
    """Indices below `counts` for numbers that were drawn from 0 to 1."""
    return (drawn.double() * counts).long()


def _linear_weights(positions: NDArray[np.float32]) -> NDArray[np.float32]:
    """(B, corners + D) weights of the corners of a cell at positions (B, D), 0 to 1 inside it."""
    count, dimensions = positions.shape
    weights = np.zeros((count, 2**dimensions + dimensions), dtype=np.float32)
    corners = np.ones((count, 1), dtype=np.float32)
    for position in positions.T[..., None]:  # the last dimension is the fastest
        corners = np.stack([corners * (1 - position), corners * position], axis=2)
        corners = corners.reshape(count, -1)
    weights[:, : 2**dimensions] = corners
    return weights


def _bends(positions: NDArray[np.float32], closeness: NDArray[np.float32]) -> NDArray[np.float32]:
    """(B, corners + D) what makes parabolas of linear weights, for each dimension on its own.

    A parabola through the values at 0, 1 and s differs from the line through those at 0 and 1 by
    the second divided difference, times t (t - 1) at t.

    Args:
        positions: (B, D) t in each dimension.
        closeness: (B, D) 1 / s; zero where there is no third value.
    """
    count, dimensions = positions.shape
    bends = np.zeros((count, 2**dimensions + dimensions), dtype=np.float32)
    at_point = positions * (positions - 1) * closeness
    at_neighbour = at_point / (1 - closeness)
    at_third = at_neighbour * closeness
    bends[:, 0] = at_point.sum(1)
    bends[:, 2**dimensions :] = at_third
    for dimension in range(dimensions):
        bends[:, _moved_in(dimension, dimensions)] = -at_neighbour[:, dimension]
    return bends


def _moved_in(dimension: int, dimensions: int) -> int:
    """Index of the corner of a cell that differs from the first one in this dimension only."""
    return int(2 ** (dimensions - 1 - dimension))


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


class _Cell(NamedTuple):
    """A cell of the grid, as a point at one of its corners sees it.

    Attributes:
        points: the corners, the point itself first, the last dimension fastest; then for each
            dimension a third point on the line through the point and its neighbour, beyond the
            cell, or the point itself where there is none that helps.
        closeness: for each dimension, 1 / s for a third point that is s times as far away as the
            neighbour, in its direction; zero where there is none.
    """

    points: list[_Point]
    closeness: list[float]


def _cells_at(point: _Point, neighbours: Sequence[Mapping[_Point, list[_Point]]]) -> list[_Cell]:
    """The cells at a point.

    A cell is flat in a dimension in which the point has no neighbour or a corner is missing.
    """
    cells = [[point]]
    for dimension in range(len(neighbours)):
        cells = [
            [corner for pair in zip(cell, moved, strict=True) for corner in pair]
            for cell in cells
            for moved in _moved_cells(cell, neighbours[dimension], dimension)
        ]
    return [_with_third_points(cell, neighbours) for cell in cells]


def _with_third_points(
    corners: list[_Point], neighbours: Sequence[Mapping[_Point, list[_Point]]]
) -> _Cell:
    third_points, closeness = [], []
    for dimension, along in enumerate(neighbours):
        moved = corners[_moved_in(dimension, len(neighbours))]
        third, close = _third_point(corners[0], moved, along, dimension)
        third_points.append(third)
        closeness.append(close)
    return _Cell(corners + third_points, closeness)


def _third_point(
    point: _Point, moved: _Point, along: Mapping[_Point, list[_Point]], dimension: int
) -> tuple[_Point, float]:
    """A third point beside a point and its neighbour along a dimension, and its closeness.

    Without a neighbour, or a third point that helps: the point itself, and zero.
    """
    if moved != point:
        start = point.values[dimension]
        for third in (*along[point], *along[moved]):
            if third not in (point, moved):
                close = (moved.values[dimension] - start) / (third.values[dimension] - start)
                if LEAST_CLOSENESS <= close <= LARGEST_CLOSENESS:
                    return third, close
    return point, 0.0


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
