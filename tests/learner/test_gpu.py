"""The kernel for GPUs: on one, where there is one, else in Triton's interpreter."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import pairwise

import pytest
import torch
from torch import Tensor

ON_GPU = torch.cuda.is_available()
if not ON_GPU:
    os.environ["TRITON_INTERPRET"] = "1"  # before the kernels are imported
pytest.importorskip("triton", reason="no GPU here, and no Triton whose interpreter could stand in")

from learner import mtrnn  # noqa: E402
from learner.kernels import gpu  # noqa: E402

DEVICE = torch.device("cuda" if ON_GPU else "cpu")
LEVELS = [[3], [20], [3, 4, 5], [1, 1, 1], [20, 30, 50], [40, 24]]


def problem(sizes: Sequence[int], *, within_step: bool, steps: int, batch: int) -> list[Tensor]:
    """Drive, keep, initial, delayed and immediate of a scan through some levels."""
    generator = torch.Generator().manual_seed(len(sizes))
    units = sum(sizes)

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64) / units**0.5

    keep = torch.rand(units, generator=generator, dtype=torch.float64)
    immediate = [draw(own, below) for below, own in pairwise(sizes)]
    tensors = [draw(steps, units, batch), keep, draw(units, batch), 2 * draw(units, units)]
    return tensors + (immediate if within_step else [])


def to_kernel(tensors: Sequence[Tensor]) -> list[Tensor]:
    return [tensor.to(DEVICE, torch.float32) for tensor in tensors]


def assert_alike(result: Tensor, expected: Tensor) -> None:
    difference = (result.cpu().double() - expected).abs().max()
    assert difference <= 1e-5 * expected.abs().max()


@pytest.mark.parametrize("within_step", [True, False])
@pytest.mark.parametrize("sizes", LEVELS, ids=str)
def test_scan_agrees_with_the_loop(sizes: list[int], within_step: bool) -> None:
    drive, keep, initial, delayed, *immediate = problem(
        sizes, within_step=within_step, steps=6, batch=3
    )
    expected = mtrnn._run(drive, keep, initial, delayed, immediate)
    by_hidden = torch.randn_like(expected)
    expected_deltas = mtrnn._run_back(by_hidden, expected, keep, delayed, immediate)

    drive, keep, initial, delayed, *immediate = to_kernel(
        [drive, keep, initial, delayed, *immediate]
    )
    hidden = gpu.run(drive, keep, initial, delayed, immediate)
    deltas = gpu.run_back(by_hidden.to(hidden), hidden, keep, delayed, immediate)
    assert_alike(hidden, expected)
    assert_alike(deltas, expected_deltas)


@pytest.mark.skipif(not ON_GPU, reason="no GPU here")
def test_the_scan_runs_on_the_gpu() -> None:
    """All of it: the kernel is chosen, and autograd goes through it."""
    drive, keep, _, delayed, *immediate = to_kernel(
        problem([20, 30, 50], within_step=True, steps=130, batch=45)
    )
    assert gpu.serves(drive, immediate)
    results = []
    for device in ("cpu", "cuda"):
        leaves = [
            each.detach().to(device).requires_grad_() for each in (drive, delayed, *immediate)
        ]
        activity = mtrnn.recurrent_scan(leaves[0], 1 - keep.to(device), leaves[1], leaves[2:])
        gradients = torch.autograd.grad(activity.square().mean(), leaves)
        results.append([each.cpu() for each in (activity, *gradients)])
    for by_loop, by_kernel in zip(*results, strict=True):
        assert_alike(by_kernel, by_loop)
