"""The compiled feature maps agree with PyTorch's, in float64."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from learner.kernels import maps as kernel
from learner.network.mstnn import Maps
from learner.network.subnets import Subnet

DOUBLE = torch.float64


@st.composite
def subnets(draw: st.DrawFn) -> tuple[Maps, int, int]:
    """A subnet of any sizes, and height and width below it."""
    maps_below, maps = draw(st.integers(1, 4)), draw(st.integers(1, 7))
    kernel_height, kernel_width = draw(st.integers(1, 7)), draw(st.integers(1, 23))
    height = kernel_height + draw(st.integers(0, 9))
    width = kernel_width + draw(st.integers(0, 20))
    subnet = Subnet(
        "maps",
        "V",
        (maps, 1, 1),
        draw(st.floats(1, 60)),
        (kernel_width, kernel_height),
        draw(st.integers(1, 4)),
        {"kernel": (maps, maps_below, kernel_height, kernel_width), "bias": (maps,)},
    )
    return initialized(Maps(subnet).to(DOUBLE)), height, width


def initialized(maps: Maps) -> Maps:
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in maps.parameters():
            parameter.uniform_(-0.3, 0.3, generator=generator)
    return maps


def gradients(activity: Tensor, by: list[Tensor]) -> list[Tensor]:
    weights = torch.randn(activity.shape, generator=torch.Generator().manual_seed(2), dtype=DOUBLE)
    return list(torch.autograd.grad((activity * weights).sum(), by))


@settings(max_examples=60)
@given(subnet=subnets(), sequences=st.integers(1, 4), steps=st.integers(1, 13))
def test_kernel_agrees_with_autograd(
    subnet: tuple[Maps, int, int], sequences: int, steps: int
) -> None:
    maps, height, width = subnet
    shape = (sequences, steps, maps.kernel.shape[1], height, width)
    below = torch.randn(shape, generator=torch.Generator().manual_seed(3), dtype=DOUBLE)
    by = [below.requires_grad_(), *maps.parameters()]
    activity, expected = maps(below), maps.reference(below)
    torch.testing.assert_close(activity, expected, rtol=1e-10, atol=1e-12)
    for ours, right in zip(gradients(activity, by), gradients(expected, by), strict=True):
        torch.testing.assert_close(ours, right, rtol=1e-9, atol=1e-10)


def test_second_derivatives_are_refused() -> None:
    maps = initialized(
        Maps(Subnet("maps", "V", (1, 1, 1), 2, (2, 2), 1, {"kernel": (1, 1, 2, 2), "bias": (1,)}))
    )
    activity = maps(torch.ones(1, 2, 1, 4, 4))
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.grad(activity.sum(), maps.kernel, create_graph=True)


def test_arrays_of_wrong_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="below"):
        kernel.maps(torch.ones(1, 1, 2, 5, 5), torch.ones(1, 3, 2, 2), torch.ones(1), 1, 2.0)
