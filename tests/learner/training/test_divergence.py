"""All implementations of the loss and its gradients agree with the stepwise one in float64."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from learner.bench.reference import stepwise_divergence
from learner.kernels import core
from learner.kernels.build import NotCompiledError, find_or_compile
from learner.kernels.library import learning_library
from learner.network.vmdnn import VMDNN
from learner.training.divergence import add_gradients, divergence, reference_divergence
from learner.training.sequences import Minibatch, Sequences
from proto.config import NetworkConfig

Loss = Callable[[VMDNN, Minibatch], Tensor]
DOUBLE = torch.float64


@pytest.fixture(scope="module")
def _compiled() -> None:
    try:
        find_or_compile()
    except NotCompiledError as error:
        pytest.skip(f"the C++ kernel is not compiled here: {error}")


sizes = st.integers(1, 23)
taus = st.floats(1, 200)


@st.composite
def configs(draw: st.DrawFn) -> NetworkConfig:
    """Networks with any levels; the vision has maps x 2 x 3 units."""

    def level() -> dict[str, object]:
        return {"units": draw(sizes), "tau": draw(taus)}

    return NetworkConfig.model_validate(
        {
            "mstnn_fast": {"maps": 1, "kernel": (60, 45), "stride": 1, "tau": 2},
            "mstnn_slow": {"maps": draw(sizes), "kernel": (3, 3), "stride": 1, "tau": 2},
            "pfc": level(),
            "mtrnn_slow": level(),
            "mtrnn_fast": level(),
            "softmax_units": draw(st.integers(2, 12)),
            "update_order": draw(st.sampled_from(["bottom_up", "literal"])),
        }
    )


def network_of(config: NetworkConfig, seed: int = 1, limit: float = 0.5) -> VMDNN:
    network = VMDNN(config).to(DOUBLE)
    network.initialize(
        torch.Generator().manual_seed(seed), initial_range=limit, pfc_input_range=limit
    )
    return network


def sequences_for(network: VMDNN, lengths: list[int], seed: int = 2) -> Sequences:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=DOUBLE)

    inputs = network.pfc.input.shape[1]
    return Sequences.stacked(
        [draw(length, inputs) for length in lengths],
        [torch.softmax(2 * draw(length, *network.outputs.shape), -1) for length in lengths],
    )


def as_type(sequences: Sequences, dtype: torch.dtype) -> Sequences:
    return Sequences(*(tensor.to(dtype) for tensor in vars(sequences).values()))


def loss_and_gradients(
    loss: Loss, network: VMDNN, sequences: Sequences, chosen: Tensor, initial: Tensor
) -> list[Tensor]:
    """The loss, and its gradients by the parameters, what was seen, its shift, and the state."""
    seen = sequences.seen.clone().requires_grad_()
    initial = initial.clone().requires_grad_()
    generator = torch.Generator().manual_seed(3)
    shift = torch.randn(len(chosen), seen.shape[2], generator=generator, dtype=DOUBLE)
    shift = shift.to(seen.dtype).requires_grad_()
    differentiable = Sequences(**{**vars(sequences), "seen": seen})
    value = loss(network, Minibatch(differentiable, chosen, initial, shift))
    by = [*network.core_parameters(), seen, initial, shift]
    gradients = torch.autograd.grad(3 * value, by, allow_unused=True, materialize_grads=True)
    return [value.detach(), *gradients]


def in_single_precision(
    network: VMDNN, sequences: Sequences, chosen: Tensor, initial: Tensor
) -> list[Tensor]:
    """Compute loss and gradients with the kernel in float32."""
    single = VMDNN(network.config)
    single.load_state_dict(network.state_dict())
    narrowed = as_type(sequences, torch.float32)
    return loss_and_gradients(divergence, single, narrowed, chosen, initial.float())


def assert_alike(
    results: list[Tensor], expected: list[Tensor], tolerance: float, *, least_scale: float = 0.0
) -> None:
    """Compare tensors to within a fraction of the largest entry of each tensor.

    Args:
        results: the tensors to test, the loss (if there is one) before the gradients.
        expected: the right tensors.
        tolerance: allowed difference as a fraction of a tensor's scale, its largest entry.
        least_scale: smallest scale as a fraction of the largest entry of all gradients. A small
            gradient is a sum of larger terms that nearly cancel, so its rounding error in float32
            does not shrink with it.
    """
    largest = max(right.abs().max().item() for right in expected[1:])
    for result, right in zip(results, expected, strict=True):
        assert result.shape == right.shape
        scale = max(right.abs().max().item(), least_scale * largest)
        difference = (result.to(DOUBLE) - right).abs().max().item()
        assert difference <= tolerance * (scale + 1e-9)


@pytest.mark.usefixtures("_compiled")
@settings(max_examples=40)
@given(
    config=configs(),
    lengths=st.lists(st.integers(1, 40), min_size=1, max_size=20),
    data=st.data(),
)
def test_kernel_and_pytorch_agree_with_stepwise_autograd(
    config: NetworkConfig, lengths: list[int], data: st.DataObject
) -> None:
    network = network_of(config)
    sequences = sequences_for(network, lengths)
    order = data.draw(st.permutations(range(len(lengths))))
    chosen = torch.tensor(order[: data.draw(st.integers(1, len(order)))])
    units = sum(level.units for level in network.levels())
    initial = torch.randn(len(chosen), units, dtype=DOUBLE)
    expected = loss_and_gradients(stepwise_divergence, network, sequences, chosen, initial)

    assert_alike(
        loss_and_gradients(divergence, network, sequences, chosen, initial), expected, 1e-10
    )
    assert_alike(
        loss_and_gradients(reference_divergence, network, sequences, chosen, initial),
        expected,
        1e-10,
    )
    results = in_single_precision(network, sequences, chosen, initial)
    assert_alike(results, expected, 3e-4, least_scale=1e-3)


@pytest.mark.usefixtures("_compiled")
@pytest.mark.parametrize("order", ["bottom_up", "literal"])
def test_paper_network_in_single_precision(order: str) -> None:
    """At the paper's sizes float32 gives a relative accuracy of 1e-5."""
    config = NetworkConfig.model_validate({"update_order": order})
    network = network_of(config, limit=0.1)
    sequences = sequences_for(network, [70, 130, 101, 130, 125])
    chosen, initial = torch.arange(5), torch.zeros(5, 100, dtype=DOUBLE)
    expected = loss_and_gradients(stepwise_divergence, network, sequences, chosen, initial)
    results = in_single_precision(network, sequences, chosen, initial)
    assert_alike(results, expected, 1e-5)


@pytest.mark.usefixtures("_compiled")
@pytest.mark.parametrize("order", ["bottom_up", "literal"])
@pytest.mark.parametrize("shifted", [True, False])
def test_gradients_are_accumulated_as_by_backward(order: str, shifted: bool) -> None:
    network = network_of(NetworkConfig.model_validate({"update_order": order}))
    sequences, chosen = sequences_for(network, [1, 40, 33, 7] * 5), torch.randperm(20)[:18]
    shift = torch.randn(18, sequences.seen.shape[2], dtype=DOUBLE) if shifted else None
    parameters = network.core_parameters()
    for _ in range(2):
        loss = stepwise_divergence(network, Minibatch(sequences, chosen, shift=shift))
        loss.backward()
    expected = [parameter.grad for parameter in parameters]
    network.zero_grad()
    minibatch = Minibatch(sequences, chosen, shift=shift)
    for _ in range(2):
        assert add_gradients(network, minibatch) == pytest.approx(loss.item())
    assert_alike([p.grad for p in parameters], expected, 1e-10)


@pytest.mark.usefixtures("_compiled")
def test_small_activities_keep_their_relative_accuracy() -> None:
    """With small initial weights activities are about 1e-4; their relative accuracy is the same."""
    network = network_of(NetworkConfig(), limit=1e-3)
    sequences = sequences_for(network, [50] * 3)
    chosen, initial = torch.arange(3), torch.zeros(3, 100, dtype=DOUBLE)
    expected = loss_and_gradients(stepwise_divergence, network, sequences, chosen, initial)
    results = in_single_precision(network, sequences, chosen, initial)
    assert_alike(results, expected, 1e-5)


@pytest.mark.usefixtures("_compiled")
def test_second_derivatives_are_refused() -> None:
    network = network_of(NetworkConfig())
    loss = divergence(network, Minibatch.of_all(sequences_for(network, [4])))
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.grad(loss, network.core_parameters(), create_graph=True)


@pytest.mark.usefixtures("_compiled")
def test_the_loss_is_the_same_without_gradients() -> None:
    network = network_of(NetworkConfig())
    minibatch = Minibatch(sequences_for(network, [20, 7]), torch.tensor([1, 0]))
    with torch.no_grad():
        value = divergence(network, minibatch)
    assert not value.requires_grad
    assert value == divergence(network, minibatch)


@pytest.mark.usefixtures("_compiled")
def test_sequences_of_another_network_are_refused() -> None:
    network = network_of(NetworkConfig())
    other = network_of(NetworkConfig(softmax_units=7))
    with pytest.raises(ValueError, match="codes"):
        divergence(network, Minibatch.of_all(sequences_for(other, [3])))


@pytest.mark.usefixtures("no_compiler")
def test_without_a_compiler_pytorch_computes_the_loss(caplog: pytest.LogCaptureFixture) -> None:
    learning_library.cache_clear()
    try:
        network = network_of(NetworkConfig())
        minibatch = Minibatch.of_all(sequences_for(network, [5]))
        assert not core.supports(minibatch.sequences.seen)
        expected = reference_divergence(network, minibatch)
        assert torch.equal(divergence(network, minibatch), expected)
        assert add_gradients(network, minibatch) == expected
    finally:
        learning_library.cache_clear()
    assert len([line for line in caplog.messages if "no C++ compiler" in line]) == 1
