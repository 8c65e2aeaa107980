"""Adam agrees with PyTorch's Adam after PyTorch's clipping, compiled or not."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from torch import Tensor, nn

from learner.kernels.build import NotCompiledError, find_or_compile
from learner.training.adam import Adam

DOUBLE = torch.float64
SHAPES = [(7, 5), (3,), (2, 3, 4)]  # together no multiple of a vector's lanes


@pytest.fixture(params=["compiled", "PyTorch"], autouse=True)
def _each_way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "PyTorch":
        monkeypatch.setattr("learner.training.adam.kernel.supports", lambda _: False)
        return
    try:
        find_or_compile()
    except NotCompiledError as error:
        pytest.skip(f"the C++ kernels are not compiled here: {error}")


def draw(seed: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(shape, generator=generator, dtype=DOUBLE) for shape in SHAPES]


def parameters_of(dtype: torch.dtype = DOUBLE) -> list[nn.Parameter]:
    return [nn.Parameter(values.to(dtype)) for values in draw(0)]


def learn(adam: Adam, parameters: Sequence[nn.Parameter], numbers: range) -> None:
    for number in numbers:
        for parameter, gradient in zip(parameters, draw(number), strict=True):
            (parameter * gradient.to(parameter.dtype)).sum().backward()
        adam.step(rate=0.1 / number)


def learn_as_pytorch(
    parameters: Sequence[nn.Parameter], numbers: range, max_norm: float | None
) -> torch.optim.Adam:
    adam = torch.optim.Adam(parameters)
    for number in numbers:
        for parameter, gradient in zip(parameters, draw(number), strict=True):
            parameter.grad = gradient
        if max_norm is not None:
            nn.utils.clip_grad_norm_(parameters, max_norm)
        adam.param_groups[0]["lr"] = 0.1 / number
        adam.step()
    return adam


def assert_alike(
    results: Sequence[Tensor], expected: Sequence[Tensor], tolerance: float = 1e-12
) -> None:
    for result, right in zip(results, expected, strict=True):
        torch.testing.assert_close(result.to(DOUBLE), right, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("max_norm", [None, 0.5, 100.0])
@pytest.mark.parametrize(("dtype", "tolerance"), [(DOUBLE, 1e-12), (torch.float32, 1e-5)])
def test_steps_are_those_of_pytorch(
    max_norm: float | None, dtype: torch.dtype, tolerance: float
) -> None:
    results, expected = parameters_of(dtype), parameters_of()
    learn(Adam(results, max_norm), results, range(1, 20))
    learn_as_pytorch(expected, range(1, 20), max_norm)
    assert_alike(results, expected, tolerance)


def test_it_continues_from_a_state_of_pytorch() -> None:
    """Their names are the same, so that checkpoints are."""
    parameters = parameters_of()
    state = learn_as_pytorch(parameters, range(1, 6), None).state_dict()["state"]
    adam = Adam(parameters)
    adam.load_tensors({f"{i}.{name}": state[i][name] for i in state for name in state[i]})
    learn(adam, parameters, range(6, 10))
    expected = parameters_of()
    learn_as_pytorch(expected, range(1, 10), None)
    assert_alike(parameters, expected)


def test_an_incomplete_state_is_refused() -> None:
    adam = Adam(parameters_of())
    tensors = adam.tensors()
    del tensors["1.exp_avg"]
    with pytest.raises(KeyError, match="exp_avg"):
        adam.load_tensors(tensors)


def test_parameters_keep_their_values_and_get_zero_gradients() -> None:
    parameters = parameters_of()
    Adam(parameters)
    for parameter, values in zip(parameters, draw(0), strict=True):
        assert torch.equal(parameter, values)
        assert parameter.is_contiguous()
        assert parameter.grad is not None
        assert not parameter.grad.any()
