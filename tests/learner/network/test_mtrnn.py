from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from learner.network.mtrnn import recurrent_scan

SIZES = (3, 4, 5)
UNITS = sum(SIZES)
LEAKS = torch.cat([torch.full((n,), 1 / tau) for n, tau in zip(SIZES, (20, 5, 2), strict=True)])
DOUBLE = torch.float64


def weights(*, within_step: bool) -> tuple[Tensor, list[Tensor]]:
    delayed = torch.randn(UNITS, UNITS, dtype=DOUBLE)
    immediate = [torch.randn(4, 3, dtype=DOUBLE), torch.randn(5, 4, dtype=DOUBLE)]
    return delayed, immediate if within_step else []


def step_by_step(drive: Tensor, delayed: Tensor, immediate: Sequence[Tensor]) -> Tensor:
    """Eq. (1) and (2) as they are read, unit by unit from the first level to the last."""
    leaks = LEAKS.to(DOUBLE)[:, None]
    inside = torch.zeros(UNITS, UNITS, dtype=DOUBLE)
    if immediate:
        inside[3:7, 0:3], inside[7:12, 3:7] = immediate
    potential = torch.zeros_like(drive[0])
    before = torch.zeros_like(drive[0])
    activities = []
    for now in drive:
        activity = torch.zeros_like(now)
        for units in (slice(0, 3), slice(3, 7), slice(7, 12)):
            total = now + delayed @ before + inside @ activity
            part = (1 - leaks) * potential + leaks * total
            keep = torch.arange(UNITS)[:, None]
            own = (keep >= units.start) & (keep < units.stop)
            potential = torch.where(own, part, potential)
            activity = torch.where(own, 1.7159 * torch.tanh(2 / 3 * potential), activity)
        before = activity
        activities.append(activity)
    return torch.stack(activities)


@pytest.mark.parametrize("within_step", [True, False])
def test_scan_is_the_recursion(within_step: bool) -> None:
    delayed, immediate = weights(within_step=within_step)
    drive = torch.randn(9, UNITS, 2, dtype=DOUBLE)
    scanned = recurrent_scan(drive, LEAKS.to(DOUBLE), delayed, immediate)
    torch.testing.assert_close(scanned, step_by_step(drive, delayed, immediate))


@pytest.mark.parametrize("within_step", [True, False])
def test_gradient_agrees_with_finite_differences(within_step: bool) -> None:
    delayed, immediate = weights(within_step=within_step)
    drive = torch.randn(6, UNITS, 2, dtype=DOUBLE, requires_grad=True)
    for tensor in (delayed, *immediate):
        tensor.requires_grad_()

    def scan(drive: Tensor, delayed: Tensor, *immediate: Tensor) -> Tensor:
        return recurrent_scan(drive, LEAKS.to(DOUBLE), delayed, immediate)

    assert torch.autograd.gradcheck(scan, (drive, delayed, *immediate))


def test_delta_of_equation_6_is_the_gradient() -> None:
    """The recursion of eq. (6), its first case with the sign that follows from eq. (5).

    Literal order: every connection takes a step, the one to the outputs too.
    """
    steps, outputs = 12, 6
    leaks = LEAKS.to(DOUBLE)
    delayed, _ = weights(within_step=False)
    drive = torch.randn(steps, UNITS, 1, dtype=DOUBLE, requires_grad=True)
    to_outputs = torch.randn(outputs, UNITS, dtype=DOUBLE)
    teacher = torch.softmax(torch.randn(steps, outputs, dtype=DOUBLE), -1)

    activity = recurrent_scan(drive, leaks, delayed, [])[..., 0]
    before = torch.cat([torch.zeros(1, UNITS, dtype=DOUBLE), activity[:-1]])
    output = torch.softmax(before @ to_outputs.T, -1)
    (teacher * (teacher / output).log()).sum().backward()  # eq. (5)
    assert drive.grad is not None
    # leaks * drive is added to u, so dE/du = dE/ddrive / leaks
    by_autograd = drive.grad[..., 0] / leaks

    delta_outputs = output - teacher  # i in M_O; tau = 1, so nothing is carried over
    slope = 2 / 3 * (1.7159 - activity**2 / 1.7159)  # f'(u)
    delta = torch.zeros(steps + 1, UNITS, dtype=DOUBLE)
    for step in reversed(range(steps)):
        after = delta[step + 1]
        arriving = delayed.T @ (leaks * after)
        if step + 1 < steps:
            arriving = arriving + to_outputs.T @ delta_outputs[step + 1]
        delta[step] = (1 - leaks) * after + arriving * slope[step]
    torch.testing.assert_close(delta[:-1], by_autograd.detach())
