from __future__ import annotations

from itertools import product

import torch
from hypothesis import given
from hypothesis import strategies as st

from learner.interpolation import REACH, Mixture, Neighbours

PLACES, YAWS = (0.2, 0.25, 0.3), (-45.0, 0.0, 45.0)
GRID = [{"yaw": yaw, "y": y} for y, yaw in product(PLACES, YAWS)]


def drawn(neighbours: Neighbours, index: int, draws: int = 300) -> Mixture:
    generator = torch.Generator().manual_seed(1)
    return neighbours.mixture(torch.full((draws,), index), 1.0, generator)


def test_neighbours_differ_in_one_value_and_none_lies_between() -> None:
    neighbours = Neighbours(GRID, [10] * 9)
    around = [sorted(set(drawn(neighbours, index).partners.tolist())) for index in range(9)]
    assert around[0] == [1, 3]
    assert around[1] == [0, 2, 4]
    assert around[4] == [1, 3, 5, 7]


def test_every_repeat_of_a_neighbour_is_drawn_and_none_of_its_own_situation() -> None:
    neighbours = Neighbours([GRID[0], GRID[1], GRID[1], GRID[0], GRID[1]], [10] * 5)
    assert set(drawn(neighbours, 0).partners.tolist()) == {1, 2, 4}


def test_without_neighbours_a_sequence_stays_as_it_is() -> None:
    elsewhere = {"y": 0.22, "yaw": 10.0}
    neighbours = Neighbours([*GRID, elsewhere, {"y": 0.2}], [10] * 11)
    values = torch.arange(11.0)
    for index in (9, 10):
        assert drawn(neighbours, index).of(values).eq(index).all()


def test_sequences_of_different_lengths_are_not_mixed() -> None:
    neighbours = Neighbours(GRID[:3], [10, 11, 10])
    assert set(drawn(neighbours, 0).partners.tolist()) == {2}
    assert set(drawn(neighbours, 1).partners.tolist()) == {1}


def test_mixtures_lie_between_and_a_little_beyond() -> None:
    mixture = drawn(Neighbours(GRID, [10] * 9), 4, draws=2000)
    assert -REACH <= mixture.weights.min() < -0.8 * REACH
    assert 1 + 0.8 * REACH < mixture.weights.max() <= 1 + REACH


@given(share=st.floats(0, 1), seed=st.integers(0, 2**31))
def test_a_share_is_mixed_and_the_rest_stays(share: float, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randint(9, (400,), generator=generator)
    mixture = Neighbours(GRID, [10] * 9).mixture(chosen, share, generator)
    values = torch.randn(9, 3, generator=generator)
    kept = mixture.weights == 0
    assert torch.equal(mixture.of(values)[kept], values[chosen][kept])
    assert abs((~kept).float().mean() - share) < 0.15


def test_a_mixture_is_linear() -> None:
    mixture = Mixture(torch.tensor([0, 2]), torch.tensor([1, 2]), torch.tensor([0.25, 0.6]))
    values = torch.tensor([[0.0, 4.0], [8.0, 0.0], [1.0, 1.0]])
    assert torch.equal(mixture.of(values), torch.tensor([[2.0, 3.0], [1.0, 1.0]]))
