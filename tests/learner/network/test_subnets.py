from __future__ import annotations

import pytest

from learner.network.subnets import parameter_shapes, subnets
from learner.network.vmdnn import VMDNN
from proto.config import MapsConfig, NetworkConfig
from proto.errors import UserError


def test_sizes_are_those_of_the_paper() -> None:
    sizes = {
        subnet.symbol: (subnet.shape, subnet.kernel, subnet.stride, subnet.tau)
        for subnet in subnets(NetworkConfig()).values()
    }
    assert sizes == {
        "V_I": ((1, 48, 64), None, None, 1),
        "V_F": ((3, 18, 22), (22, 14), 2, 2),
        "V_S": ((6, 7, 8), (8, 6), 2, 30),
        "PFC": ((20,), (8, 7), 1, 150),
        "M_S": ((30,), None, None, 10),
        "M_F": ((50,), None, None, 2),
        "M_O": ((11, 10), None, None, 1),
    }


def test_connections_are_those_of_the_paper() -> None:
    shapes = parameter_shapes(NetworkConfig())
    assert shapes["pfc.feedback"] == (20, 30)
    assert shapes["mtrnn_slow.feedback"] == (30, 50)
    assert "mtrnn_fast.feedback" not in shapes
    assert not [name for name in shapes if name.startswith("mstnn") and "recurrent" in name]


def test_network_has_exactly_the_listed_parameters() -> None:
    config = NetworkConfig(mstnn_slow=MapsConfig(maps=4, kernel=(5, 9), stride=3, tau=7))
    network = VMDNN(config)
    assert {name: tuple(p.shape) for name, p in network.state_dict().items()} == parameter_shapes(
        config
    )
    counted = sum(subnet.weights + subnet.biases for subnet in subnets(config).values())
    assert counted == sum(p.numel() for p in network.parameters())


def test_kernel_that_does_not_fit_is_refused() -> None:
    config = NetworkConfig(mstnn_slow=MapsConfig(maps=6, kernel=(8, 19), stride=2, tau=30))
    with pytest.raises(UserError, match=r"mstnn_slow.kernel: 8 x 19 .* V_F, which is 22 x 18"):
        subnets(config)
