"""The compiled step of Adam agrees with its definition in PyTorch."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from learner.kernels import adam
from learner.kernels.adam import AdamArrays
from learner.training.adam import reference_step

TOLERANCES = {torch.float64: 1e-12, torch.float32: 2e-5}


def arrays_of(count: int, dtype: torch.dtype, seed: int) -> AdamArrays:
    generator = torch.Generator().manual_seed(seed)
    weights, gradient, means, squares = torch.randn(4, count, generator=generator, dtype=dtype)
    return AdamArrays(weights, gradient, means, squares.square())


@given(
    count=st.integers(1, 200),
    dtype=st.sampled_from(list(TOLERANCES)),
    number=st.integers(1, 1000),
    max_norm=st.one_of(st.just(float("inf")), st.floats(1e-3, 100)),
    seed=st.integers(0, 2**31),
)
def test_it_agrees_with_the_definition(
    count: int, dtype: torch.dtype, number: int, max_norm: float, seed: int
) -> None:
    compiled, expected = arrays_of(count, dtype, seed), arrays_of(count, dtype, seed)
    adam.step(compiled, number=number, rate=1e-2, max_norm=max_norm)
    reference_step(expected, number=number, rate=1e-2, max_norm=max_norm)
    for name, values in vars(expected).items():
        tolerance = TOLERANCES[dtype]
        torch.testing.assert_close(getattr(compiled, name), values, rtol=tolerance, atol=tolerance)
    assert not compiled.gradient.any()


def test_other_types_are_not_supported() -> None:
    assert adam.supports(torch.zeros(3))
    assert not adam.supports(torch.zeros(3, dtype=torch.float16))
    assert not adam.supports(torch.zeros(3, device="meta"))


@pytest.mark.parametrize("dtype", list(TOLERANCES))
def test_a_gradient_of_zero_changes_no_weights(dtype: torch.dtype) -> None:
    zeros = AdamArrays(*(torch.zeros(5, dtype=dtype) for _ in range(4)))
    adam.step(zeros, number=1, rate=0.1, max_norm=1.0)
    assert not zeros.weights.any()
