from __future__ import annotations

import pytest
import torch
from torch.nn import functional

from learner.network.mstnn import Maps, leaky_integral
from learner.network.subnets import subnets
from proto.config import MapsConfig, NetworkConfig


@pytest.mark.parametrize("tau", [1, 2.5, 150])
def test_leaky_integral_is_the_recursion(tau: float) -> None:
    drive = torch.randn(2, 40, 3, dtype=torch.float64)
    potential = torch.zeros(2, 3, dtype=torch.float64)
    integral = leaky_integral(drive, tau)
    for step in range(40):
        potential = (1 - 1 / tau) * potential + drive[:, step] / tau
        torch.testing.assert_close(integral[:, step], potential)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_maps_follow_equations_3_and_4(stride: int) -> None:
    config = NetworkConfig(mstnn_fast=MapsConfig(maps=2, kernel=(12, 10), stride=stride, tau=4))
    subnet = subnets(config)["mstnn_fast"]
    maps = Maps(subnet).double()
    with torch.no_grad():
        for parameter in maps.parameters():
            parameter.uniform_(-0.1, 0.1)
    images = torch.rand(2, 5, 1, 48, 64, dtype=torch.float64)
    activity = maps(images)
    assert activity.shape == (2, 5, *subnet.shape)
    potential = torch.zeros(2, *subnet.shape, dtype=torch.float64)
    for step in range(5):
        drive = functional.conv2d(images[:, step], maps.kernel, maps.bias, stride)
        potential = (1 - 1 / 4) * potential + drive / 4
        expected = 1.7159 * torch.tanh(2 / 3 * potential)
        torch.testing.assert_close(activity[:, step], expected)
