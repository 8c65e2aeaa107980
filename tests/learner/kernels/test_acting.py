"""The compiled network that acts: its parameters, its arrays and its state.

`tests/learner/network/test_compiled_network.py` compares its numbers with numpy's.
"""

from __future__ import annotations

import gc
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from learner.kernels.acting import ActingKernel, LevelSizes, MapsSizes, NetworkSizes

SIZES = NetworkSizes(
    image=(11, 14),
    maps=(MapsSizes(2, 4, 5, 5, 6, 2, tau=2.0), MapsSizes(3, 2, 3, 3, 3, 1, tau=5.0)),
    levels=(LevelSizes(4, 20.0), LevelSizes(5, 5.0), LevelSizes(6, 2.0)),
    values=3,
    softmax_units=4,
    literal=False,
)
COUNT = (
    2 * (30 + 1)
    + 3 * (18 + 1)
    + 4 * (18 + 4 + 5 + 1)
    + 5 * (4 + 5 + 6 + 1)
    + 6 * (5 + 6 + 1)
    + 12 * 7
)


def parameters(count: int = COUNT) -> Sequence[NDArray[np.float32]]:
    return [np.random.default_rng(1).normal(size=count).astype(np.float32) / 3]


def run(kernel: ActingKernel, images: NDArray[np.float32]) -> NDArray[np.float32]:
    outputs = []
    for image in images:
        kernel.image[:] = image
        kernel.see()
        kernel.act()
        outputs.append(kernel.outputs.copy())
    return np.array(outputs)


@pytest.fixture
def images() -> NDArray[np.float32]:
    return np.random.default_rng(2).uniform(-1, 1, (5, 11, 14)).astype(np.float32)


def test_it_keeps_its_state_until_it_is_reset(images: NDArray[np.float32]) -> None:
    kernel = ActingKernel(SIZES, parameters())
    first = run(kernel, images)
    assert not np.array_equal(run(kernel, images), first)
    kernel.reset()
    np.testing.assert_array_equal(run(kernel, images), first)
    np.testing.assert_allclose(first.sum(-1), 1.0, rtol=1e-5)


def test_each_network_has_its_own_state(images: NDArray[np.float32]) -> None:
    expected = run(ActingKernel(SIZES, parameters()), images)
    one, other = ActingKernel(SIZES, parameters()), ActingKernel(SIZES, parameters())
    first = run(one, images[:2])
    run(other, -images)
    del other
    gc.collect()
    np.testing.assert_array_equal(np.concatenate([first, run(one, images[2:])]), expected)


@pytest.mark.parametrize("count", [COUNT - 1, COUNT + 1])
def test_parameters_that_do_not_fit_are_refused(count: int) -> None:
    with pytest.raises(ValueError, match=f"there are {count} parameters, not {COUNT}"):
        ActingKernel(SIZES, parameters(count))
