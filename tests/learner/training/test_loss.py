from __future__ import annotations

import pytest
import torch

from learner.training.loss import kl_divergence


def test_it_is_the_divergence_of_equation_5_per_step_and_value() -> None:
    output = torch.tensor([[0.5, 0.5], [0.25, 0.75]]).view(1, 1, 2, 2)
    teacher = torch.tensor([[0.9, 0.1], [0.25, 0.75]]).view(1, 1, 2, 2)
    by_hand = 0.9 * torch.tensor(0.9 / 0.5).log() + 0.1 * torch.tensor(0.1 / 0.5).log()
    loss = kl_divergence(output.log(), teacher, torch.ones(1, 1))
    assert loss.item() == pytest.approx(by_hand.item() / 2, rel=1e-5)


def test_the_loss_of_equal_distributions_is_zero() -> None:
    certain = torch.tensor([0.0, 1.0]).view(1, 1, 1, 2)
    outputs = torch.log_softmax(torch.tensor([-200.0, 0.0]), 0).view(1, 1, 1, 2)
    assert kl_divergence(outputs, certain, torch.ones(1, 1)).item() == 0


def test_masked_steps_are_not_counted() -> None:
    outputs = torch.log_softmax(torch.randn(2, 3, 4, 5), -1)
    targets = torch.softmax(torch.randn(2, 3, 4, 5), -1)
    mask = torch.tensor([[1.0, 1, 1], [1, 0, 0]])
    whole = kl_divergence(outputs, targets, mask)
    parts = [
        kl_divergence(outputs[:1], targets[:1], torch.ones(1, 3)) * 3,
        kl_divergence(outputs[1:, :1], targets[1:, :1], torch.ones(1, 1)),
    ]
    torch.testing.assert_close(whole, sum(parts) / 4)
