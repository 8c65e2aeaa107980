from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import torch
from hypothesis import given
from hypothesis import strategies as st

from learner.training.interpolation import OVERSHOOT, Mixtures, NeighbourGrid

Y_M, YAWS = (0.2, 0.25, 0.3), (-45.0, 0.0, 45.0)
GRID = [{"yaw": yaw, "y": y} for y, yaw in product(Y_M, YAWS)]


def drawn(grid: NeighbourGrid, index: int, share: float = 1.0, draws: int = 400) -> Mixtures:
    generator = torch.Generator().manual_seed(1)
    return grid.mixtures(torch.full((draws,), index), share, generator)


def corners(grid: NeighbourGrid, index: int, count: int = 4) -> set[tuple[int, ...]]:
    members = drawn(grid, index).members[:, :count]
    return {tuple(sorted(each)) for each in members.tolist()}


def test_a_sequence_is_mixed_with_those_at_the_corners_of_a_cell_around_it() -> None:
    grid = NeighbourGrid(GRID, [10] * 9)
    assert corners(grid, 0) == {(0, 1, 3, 4)}
    assert corners(grid, 1) == {(0, 1, 3, 4), (1, 2, 4, 5)}
    assert corners(grid, 4) == {(0, 1, 3, 4), (1, 2, 4, 5), (3, 4, 6, 7), (4, 5, 7, 8)}


@given(seed=st.integers(0, 2**31), index=st.integers(0, 8))
def test_the_situation_of_a_mixture_follows_its_weights(seed: int, index: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    grid = NeighbourGrid(GRID, [10] * 9)
    mixtures = grid.mixtures(torch.full((50,), index), 1.0, generator)
    assert torch.allclose(mixtures.weights.sum(1), torch.ones(50))
    assert torch.allclose(mixtures.target_weights.sum(1), torch.ones(50), atol=1e-5)
    assert (mixtures.members[:, 0] == index).all()
    places = torch.tensor([[one["y"], one["yaw"]] for one in GRID])
    where = mixtures.seen(places)
    near = (where - places[index]).abs()
    assert (near <= (1 + OVERSHOOT) * torch.tensor([0.0501, 45.01])).all()
    assert len({tuple(one) for one in where.tolist()}) > 40


UNEVEN_Y_M, UNEVEN_YAWS = (0.2, 0.24, 0.3), (-45.0, -20.0, 10.0, 45.0)
UNEVEN = [{"yaw": yaw, "y": y} for y, yaw in product(UNEVEN_Y_M, UNEVEN_YAWS)]
PLACES = torch.tensor([[one["y"], one["yaw"]] for one in UNEVEN], dtype=torch.float64)


@given(
    seed=st.integers(0, 2**31),
    index=st.integers(0, len(UNEVEN) - 1),
    coefficients=st.lists(st.floats(-1, 1), min_size=5, max_size=5),
)
def test_actions_that_bend_with_the_situation_are_mixed_without_error(
    seed: int, index: int, coefficients: list[float]
) -> None:
    def bent(places: torch.Tensor) -> torch.Tensor:
        y, yaw = 10 * places[:, 0], places[:, 1] / 45
        terms = torch.stack([y, yaw, y**2, yaw**2, y * yaw], 1)
        return terms @ torch.tensor(coefficients, dtype=torch.float64)

    grid = NeighbourGrid(UNEVEN, [10] * len(UNEVEN))
    generator = torch.Generator().manual_seed(seed)
    mixtures = grid.mixtures(torch.full((50,), index), 1.0, generator)
    expected = bent(mixtures.seen(PLACES))
    assert torch.allclose(mixtures.targets(bent(PLACES)), expected, atol=1e-4)


def test_what_is_seen_is_mixed_without_sequences_beyond_the_cell() -> None:
    mixtures = drawn(NeighbourGrid(GRID, [10] * 9), 4)
    assert mixtures.weights[:, 4:].eq(0).all()
    assert mixtures.target_weights[:, 4:].ne(0).any()


def test_where_a_third_value_is_missing_or_too_close_actions_are_mixed_linearly() -> None:
    for values in ((0.2, 0.25), (0.2, 0.25, 0.26)):
        grid = NeighbourGrid([{"y": y} for y in values], [10] * len(values))
        mixtures = drawn(grid, 0)
        assert torch.equal(mixtures.weights, mixtures.target_weights)


def test_every_repeat_of_a_corner_is_drawn() -> None:
    grid = NeighbourGrid([GRID[0], GRID[1], GRID[1], GRID[1]], [10] * 4)
    assert set(drawn(grid, 0).members.flatten().tolist()) == {0, 1, 2, 3}


def test_a_situation_off_the_grid_stays_as_it_is() -> None:
    grid = NeighbourGrid([*GRID, {"y": 0.22, "yaw": 10.0}], [10] * 10)
    assert drawn(grid, 9).members.eq(9).all()
    assert corners(grid, 0) == {(0, 1, 3, 4)}


def test_a_missing_corner_reduces_the_dimension_of_the_cell() -> None:
    grid = NeighbourGrid(GRID[:5], [10] * 5)  # the lower row and two of the middle one
    assert corners(grid, 0) == {(0, 1, 3, 4)}
    assert (2, 2, 2, 2) not in corners(grid, 2)
    assert all(set(members) <= {1, 2, 4} for members in corners(grid, 2))


def test_sequences_of_different_lengths_are_not_mixed() -> None:
    grid = NeighbourGrid(GRID[:3], [10, 11, 10])
    assert set(drawn(grid, 0).members.flatten().tolist()) == {0, 2}
    assert set(drawn(grid, 1).members.flatten().tolist()) == {1}


def test_only_the_given_fraction_is_mixed() -> None:
    mixtures = drawn(NeighbourGrid(GRID, [10] * 9), 4, share=0.3, draws=2000)
    kept = mixtures.weights[:, 0] == 1
    assert abs(kept.float().mean() - 0.7) < 0.05


# --- discrete values ---

SHAPES = st.sampled_from(["box", "ball", "cup"])
SITUATIONS = st.lists(
    st.fixed_dictionaries(
        {
            "object": SHAPES,
            "gesture": st.sampled_from(["wave", "point"]),
            "y": st.sampled_from(Y_M),
            "yaw": st.sampled_from(YAWS),
        }
    ),
    min_size=1,
    max_size=40,
)


def discrete(situation: Mapping[str, float | str]) -> tuple[str | float, ...]:
    return tuple(value for _, value in sorted(situation.items()) if isinstance(value, str))


@given(situations=SITUATIONS, data=st.data(), seed=st.integers(0, 2**31))
def test_only_sequences_with_the_same_discrete_values_and_length_are_mixed(
    situations: list[dict[str, float | str]], data: st.DataObject, seed: int
) -> None:
    count = len(situations)
    steps = data.draw(st.lists(st.sampled_from([10, 11]), min_size=count, max_size=count))
    grid = NeighbourGrid(situations, steps)
    generator = torch.Generator().manual_seed(seed)
    mixtures = grid.mixtures(torch.arange(count), 1.0, generator)
    assert mixtures.members.shape == (count, 4 + 2), "corners along the two continuous values"
    for index, members in enumerate(mixtures.members.tolist()):
        assert members[0] == index
        for member in members:
            assert discrete(situations[member]) == discrete(situations[index])
            assert steps[member] == steps[index]


@given(situations=SITUATIONS, seed=st.integers(0, 2**31))
def test_a_discrete_variable_divides_the_grid_into_independent_grids(
    situations: list[dict[str, float | str]], seed: int
) -> None:
    """The mixtures of a group are those of a grid of its sequences alone."""
    whole = NeighbourGrid(situations, [10] * len(situations))
    group = [
        index
        for index, situation in enumerate(situations)
        if discrete(situation) == discrete(situations[0])
    ]
    alone = NeighbourGrid([situations[index] for index in group], [10] * len(group))
    in_whole = whole.mixtures(torch.tensor(group), 1.0, torch.Generator().manual_seed(seed))
    by_itself = alone.mixtures(torch.arange(len(group)), 1.0, torch.Generator().manual_seed(seed))
    assert torch.equal(in_whole.members, torch.tensor(group)[by_itself.members])
    assert torch.equal(in_whole.weights, by_itself.weights)


@given(seed=st.integers(0, 2**31))
def test_a_constant_discrete_variable_changes_no_draw(seed: int) -> None:
    named = [{**situation, "object": "box"} for situation in GRID]
    mixtures = [
        NeighbourGrid(situations, [10] * 9).mixtures(
            torch.arange(9), 0.7, torch.Generator().manual_seed(seed)
        )
        for situations in (GRID, named)
    ]
    assert torch.equal(mixtures[0].members, mixtures[1].members)
    assert torch.equal(mixtures[0].weights, mixtures[1].weights)


def test_without_continuous_values_nothing_is_mixed() -> None:
    grid = NeighbourGrid([{"object": "box"}, {"object": "ball"}, {"object": "box"}], [10] * 3)
    mixtures = grid.mixtures(torch.arange(3), 1.0, torch.Generator().manual_seed(1))
    assert mixtures.members.tolist() == [[0], [1], [2]]
    assert mixtures.weights.tolist() == [[1.0], [1.0], [1.0]]


def test_situations_with_different_discrete_values_are_not_neighbours() -> None:
    grid = NeighbourGrid([*GRID, {"side": 0.2}, {"side": 0.25}, {"y": 0.2}], [10] * 12)
    assert corners(grid, 0) == {(0, 1, 3, 4)}
    assert corners(grid, 9) == {(9, 9, 10, 10)}, "flat along the value that it does not have"
    assert corners(grid, 11) == {(11, 11, 11, 11)}


def test_situations_that_differ_in_distractors_alone_lie_at_the_same_point() -> None:
    situations = [
        {"x_m": x, "other_m": other, "take": take}
        for x, other, take in ((0.0, 0.1, "1"), (1.0, 0.2, "2"), (0.0, 0.3, "3"))
    ]
    chosen, generator = torch.arange(3).repeat(50), torch.Generator().manual_seed(1)
    grid = NeighbourGrid(situations, [5, 5, 5], {"other_m", "take"})
    mixtures = grid.mixtures(chosen, 1.0, generator)
    partners = {(int(a), int(b)) for a, b, _ in mixtures.members}
    assert partners == {(0, 1), (1, 0), (1, 2), (2, 1)}
    alone = NeighbourGrid(situations, [5, 5, 5]).mixtures(chosen, 1.0, generator)
    assert all(len(set(members.tolist())) == 1 for members in alone.members)
