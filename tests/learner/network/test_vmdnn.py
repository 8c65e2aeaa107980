from __future__ import annotations

import pytest
import torch
from torch import Tensor

from learner.network.mtrnn import UpdateOrder
from learner.network.vmdnn import VMDNN
from learner.training.loss import kl_divergence
from proto.config import NetworkConfig

ORDERS: list[UpdateOrder] = ["bottom_up", "literal"]
DOUBLE = torch.float64


def network_of(order: UpdateOrder, limit: float = 0.3) -> VMDNN:
    network = VMDNN(NetworkConfig(update_order=order)).to(DOUBLE)
    network.initialize(torch.Generator().manual_seed(3), initial_range=limit, pfc_input_range=limit)
    return network


def some_images(steps: int, sequences: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(5)
    return torch.rand(sequences, steps, 48, 64, generator=generator, dtype=DOUBLE) * 2 - 1


@pytest.mark.parametrize("order", ORDERS)
def test_outputs_are_distributions(order: UpdateOrder) -> None:
    outputs = network_of(order)(some_images(5, 2)).exp()
    assert outputs.shape == (2, 5, 11, 10)
    torch.testing.assert_close(outputs.sum(-1), torch.ones(2, 5, 11, dtype=DOUBLE))


@pytest.mark.parametrize("order", ORDERS)
def test_gradient_agrees_with_finite_differences(order: UpdateOrder) -> None:
    network = network_of(order)
    images, mask = some_images(12, 2), torch.ones(2, 12, dtype=DOUBLE)
    mask[1, 5:] = 0
    targets = torch.softmax(torch.randn(2, 12, 11, 10, dtype=DOUBLE), -1)

    def loss() -> Tensor:
        return kl_divergence(network(images), targets, mask)

    loss().backward()
    generator = torch.Generator().manual_seed(7)
    for name, parameter in network.named_parameters():
        direction = torch.randn(parameter.shape, generator=generator, dtype=DOUBLE)
        assert parameter.grad is not None, name
        step = 1e-5
        with torch.no_grad():
            parameter.add_(direction, alpha=step)
            above = loss()
            parameter.add_(direction, alpha=-2 * step)
            below = loss()
            parameter.add_(direction, alpha=step)
        slope = (above - below) / (2 * step)
        assert slope.item() == pytest.approx(
            (parameter.grad * direction).sum().item(), rel=1e-5, abs=1e-10
        )


@pytest.mark.parametrize("order", ORDERS)
def test_later_pictures_do_not_change_earlier_outputs(order: UpdateOrder) -> None:
    network = network_of(order)
    images = some_images(12)
    changed = images.clone()
    changed[:, 5:] = 0
    before, after = network(images), network(changed)
    assert torch.equal(before[:, :5], after[:, :5])
    assert not torch.equal(before[:, 11], after[:, 11])


@pytest.mark.parametrize(("order", "delay"), [("bottom_up", 0), ("literal", 4)])
def test_literal_order_delays_each_level_by_a_step(order: UpdateOrder, delay: int) -> None:
    network = network_of(order, limit=2.0)
    images = some_images(10)
    changed = images.clone()
    changed[:, 3:] += 1
    different = (network(images) != network(changed)).flatten(2).any(-1)[0]
    assert different.tolist() == [step >= 3 + delay for step in range(10)]


def test_starts_from_the_neutral_state() -> None:
    network = network_of("literal")
    first = network(some_images(1))[0, 0].exp()
    # nothing has reached M_O yet: only its biases speak
    torch.testing.assert_close(first, torch.softmax(network.outputs.bias.view(11, 10), -1))


def test_initial_weights_fill_their_ranges() -> None:
    network = VMDNN(NetworkConfig())
    network.initialize(torch.Generator().manual_seed(1), initial_range=0.1, pfc_input_range=0.2)
    for name, parameter in network.named_parameters():
        limit = 0.2 if name == "pfc.input" else 0.1
        assert parameter.abs().max() <= limit
        if parameter.numel() > 500:
            assert parameter.max() > 0.95 * limit
            assert parameter.min() < -0.95 * limit
