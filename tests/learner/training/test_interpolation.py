from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from learner.kernels import mixing
from learner.network.softmax_code import SoftmaxCode
from learner.training.interpolation import REACH, Cells, Mixtures, mixed
from learner.training.sequences import Sequences
from proto.body import ACTION_SIZE
from proto.config import NetworkConfig

PLACES, YAWS = (0.2, 0.25, 0.3), (-45.0, 0.0, 45.0)
GRID = [{"yaw": yaw, "y": y} for y, yaw in product(PLACES, YAWS)]


def drawn(cells: Cells, index: int, share: float = 1.0, draws: int = 400) -> Mixtures:
    generator = torch.Generator().manual_seed(1)
    return cells.mixtures(torch.full((draws,), index), share, generator)


def corners(cells: Cells, index: int) -> set[tuple[int, ...]]:
    return {tuple(sorted(members)) for members in drawn(cells, index).members.tolist()}


def test_a_sequence_is_mixed_with_those_at_the_corners_of_a_cell_around_it() -> None:
    cells = Cells(GRID, [10] * 9)
    assert corners(cells, 0) == {(0, 1, 3, 4)}
    assert corners(cells, 1) == {(0, 1, 3, 4), (1, 2, 4, 5)}
    assert corners(cells, 4) == {(0, 1, 3, 4), (1, 2, 4, 5), (3, 4, 6, 7), (4, 5, 7, 8)}


@given(seed=st.integers(0, 2**31), index=st.integers(0, 8))
def test_a_mixture_lies_where_its_weights_say(seed: int, index: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    cells = Cells(GRID, [10] * 9)
    mixtures = cells.mixtures(torch.full((50,), index), 1.0, generator)
    assert torch.allclose(mixtures.weights.sum(1), torch.ones(50))
    assert (mixtures.members[:, 0] == index).all()
    places = torch.tensor([[one["y"], one["yaw"]] for one in GRID])
    where = mixtures.of(places)
    near = (where - places[index]).abs()
    assert (near <= (1 + REACH) * torch.tensor([0.0501, 45.01])).all()
    assert len({tuple(one) for one in where.tolist()}) > 40


def test_every_repeat_of_a_corner_is_drawn() -> None:
    cells = Cells([GRID[0], GRID[1], GRID[1], GRID[1]], [10] * 4)
    assert set(drawn(cells, 0).members.flatten().tolist()) == {0, 1, 2, 3}


def test_a_situation_off_the_grid_stays_as_it_is() -> None:
    cells = Cells([*GRID, {"y": 0.22, "yaw": 10.0}], [10] * 10)
    assert drawn(cells, 9).members.eq(9).all()
    assert corners(cells, 0) == {(0, 1, 3, 4)}


def test_where_a_corner_is_missing_the_cell_is_flat() -> None:
    cells = Cells(GRID[:5], [10] * 5)  # the lower row and two of the middle one
    assert corners(cells, 0) == {(0, 1, 3, 4)}
    assert (2, 2, 2, 2) not in corners(cells, 2)
    assert all(set(members) <= {1, 2, 4} for members in corners(cells, 2))


def test_sequences_of_different_lengths_are_not_mixed() -> None:
    cells = Cells(GRID[:3], [10, 11, 10])
    assert set(drawn(cells, 0).members.flatten().tolist()) == {0, 2}
    assert set(drawn(cells, 1).members.flatten().tolist()) == {1}


def test_a_share_is_mixed_and_the_rest_stays() -> None:
    mixtures = drawn(Cells(GRID, [10] * 9), 4, share=0.3, draws=2000)
    kept = mixtures.weights[:, 0] == 1
    assert abs(kept.float().mean() - 0.7) < 0.05


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_the_kernel_mixes_as_numpy_does(kind: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(2)
    ranges = (
        -torch.rand(ACTION_SIZE, generator=generator),
        torch.rand(ACTION_SIZE, generator=generator),
    )
    code = SoftmaxCode.of_ranges(*(each.numpy() for each in ranges), NetworkConfig())
    seen = torch.randn(5, 7, 21, generator=generator, dtype=kind)
    targets = torch.randn(5, 7, ACTION_SIZE, generator=generator, dtype=kind)  # some out of range
    codes = torch.from_numpy(code.encode(targets.numpy())).to(kind)
    sequences = Sequences.of(seen, codes, torch.ones(5, 7, dtype=kind))
    mixtures = Mixtures(
        torch.randint(5, (6, 4), generator=generator),
        torch.rand(6, 4, generator=generator, dtype=kind).softmax(1),
    )
    if not mixing.serves(sequences):
        pytest.skip("the kernels are not compiled here")
    compiled = mixed(mixtures, sequences, targets, code)
    monkeypatch.setattr(mixing, "serves", lambda _: False)
    reference = mixed(mixtures, sequences, targets, code)
    for name, tensor in vars(reference).items():
        assert getattr(compiled, name).dtype == kind
        np.testing.assert_allclose(getattr(compiled, name), tensor, rtol=2e-5, atol=2e-6)
