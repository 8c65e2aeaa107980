"""The compiled mixtures agree with those of PyTorch and numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from learner.kernels import mixing
from learner.network.softmax_code import SoftmaxCode
from learner.training.interpolation import Mixtures, mix_sequences
from learner.training.sequences import Sequences
from proto.body import ACTION_SIZE
from proto.config import NetworkConfig


def draw(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(sum(shape)), dtype=dtype)


@pytest.fixture
def code() -> SoftmaxCode:
    ends = torch.rand(2, ACTION_SIZE, generator=torch.Generator().manual_seed(2)).numpy()
    return SoftmaxCode.of_ranges(-ends[0], ends[1], NetworkConfig())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_kernel_mixes_as_defined(
    dtype: torch.dtype, code: SoftmaxCode, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = draw(5, 7, 21, dtype=dtype)
    targets = draw(5, 7, ACTION_SIZE, dtype=dtype)  # some are out of the code's ranges
    codes = torch.from_numpy(code.encode(targets.numpy())).to(dtype)
    sequences = Sequences.of(seen, codes, torch.ones(5, 7, dtype=dtype))
    weights = draw(6, 4, dtype=dtype).softmax(1)
    weights[1:4, 2:] = 0
    mixtures = Mixtures(
        torch.randint(5, (6, 4), generator=torch.Generator().manual_seed(3)),
        weights,
        target_weights=draw(6, 4, dtype=dtype) / 2,  # some are negative
    )
    compiled = mix_sequences(mixtures, sequences, targets, code)
    monkeypatch.setattr(mixing, "supports", lambda _: False)
    expected = mix_sequences(mixtures, sequences, targets, code)
    for name, tensor in vars(expected).items():
        assert getattr(compiled, name).dtype == dtype
        np.testing.assert_allclose(getattr(compiled, name), tensor, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"members": torch.tensor([[0, 5]])}, "members go from 0 to 5, but there are 5"),
        ({"members": torch.tensor([[-1, 0]])}, "members go from -1"),
        ({"members": torch.zeros(1, 2)}, "not .* int64"),
        ({"members": torch.zeros(0, 2, dtype=torch.int64)}, "not .* int64"),
        ({"weights": torch.ones(1, 3)}, "weights"),
        ({"target_weights": torch.ones(1, 3)}, "weights"),
        ({"targets": torch.ones(5, 6, ACTION_SIZE)}, "targets"),
        ({"targets": torch.ones(5, 7, 3)}, "targets"),
    ],
)
def test_arrays_of_wrong_shape_are_refused(
    changes: dict[str, Tensor], message: str, code: SoftmaxCode
) -> None:
    arrays = {
        "members": torch.tensor([[0, 4]]),
        "weights": torch.ones(1, 2),
        "target_weights": torch.ones(1, 2),
        "seen": draw(5, 7, 21),
        "targets": draw(5, 7, ACTION_SIZE),
    }
    with pytest.raises((ValueError, IndexError), match=message):
        mixing.mix(**{**arrays, **changes}, code=code)
