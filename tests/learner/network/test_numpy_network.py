from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from learner.network.mtrnn import UpdateOrder, run_levels
from learner.network.numpy_network import NumpyNetwork
from learner.network.subnets import subnets
from learner.network.vmdnn import VMDNN
from proto.config import MapsConfig, NetworkConfig, SubnetConfig

ODD_SIZES = {
    "mstnn_fast": MapsConfig(maps=4, kernel=(9, 7), stride=3, tau=3),
    "mstnn_slow": MapsConfig(maps=2, kernel=(5, 4), stride=1, tau=8),
    "pfc": SubnetConfig(units=3, tau=40),
    "softmax_units": 7,
}


@pytest.mark.parametrize("order", ["bottom_up", "literal"])
@pytest.mark.parametrize("sizes", [{}, ODD_SIZES], ids=["paper", "odd"])
def test_single_steps_agree_with_the_whole_sequence(
    order: UpdateOrder, sizes: dict[str, object]
) -> None:
    config = NetworkConfig.model_validate({**sizes, "update_order": order})
    network = VMDNN(config).double()
    network.initialize(torch.Generator().manual_seed(1), initial_range=0.3, pfc_input_range=0.5)
    images = torch.rand(1, 40, 48, 64, dtype=torch.float64) * 2 - 1
    at_once = network(images).exp()[0].detach().numpy()

    parameters = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    stepping = NumpyNetwork(config, parameters)
    for _ in range(2):  # a second time, from the neutral state again
        one_by_one = np.array([stepping.step(image) for image in images[0].numpy()])
        np.testing.assert_allclose(one_by_one, at_once, rtol=0, atol=1e-12)
        stepping.reset()


def test_activity_equals_that_in_training() -> None:
    config = NetworkConfig.model_validate(ODD_SIZES)
    network = VMDNN(config).double()
    network.initialize(torch.Generator().manual_seed(1), initial_range=0.3, pfc_input_range=0.5)
    images = torch.rand(1, 12, 48, 64, dtype=torch.float64) * 2 - 1
    stepping = NumpyNetwork(config, {n: t.numpy() for n, t in network.state_dict().items()})
    steps = []
    for image in images[0].numpy():
        stepping.step(image)
        steps.append(stepping.activity)
    fast = network.mstnn_fast(images.unsqueeze(2))
    last = run_levels(network.levels(), network.see(images), "bottom_up")
    assert {name: len(units) for name, units in steps[0].items()} == {
        subnet.name: math.prod(subnet.shape) for subnet in list(subnets(config).values())[1:-1]
    }
    for name, whole in (
        ("mstnn_fast", fast.flatten(2)),
        ("mstnn_slow", network.see(images)),
        ("mtrnn_fast", last),
    ):
        one_by_one = np.array([step[name] for step in steps])
        np.testing.assert_allclose(one_by_one, whole[0].detach().numpy(), rtol=0, atol=1e-12)
