"""The compiled network agrees with the numpy network."""

from __future__ import annotations

import gc
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from learner.kernels import acting
from learner.kernels.library import acting_library
from learner.network.acting import make_acting_network
from learner.network.compiled_network import CompiledNetwork
from learner.network.numpy_network import NumpyNetwork
from learner.network.subnets import parameter_shapes
from proto.body import IMAGE_HEIGHT, IMAGE_WIDTH
from proto.config import NetworkConfig

Floats = NDArray[np.float32]


@pytest.fixture
def _compiled() -> None:
    if not acting.available():
        pytest.skip("the C++ kernels are not compiled here")


def parameters_of(config: NetworkConfig, limit: float = 0.5, seed: int = 1) -> Mapping[str, Floats]:
    random = np.random.default_rng(seed)
    return {
        name: random.uniform(-limit, limit, shape).astype(np.float32)
        for name, shape in parameter_shapes(config).items()
    }


def images_for(steps: int, seed: int = 2) -> Floats:
    random = np.random.default_rng(seed)
    return random.uniform(-1, 1, (steps, IMAGE_HEIGHT, IMAGE_WIDTH)).astype(np.float32)


def in_double(config: NetworkConfig, parameters: Mapping[str, Floats]) -> NumpyNetwork:
    return NumpyNetwork(
        config, {name: values.astype(np.float64) for name, values in parameters.items()}
    )


def worst_error(config: NetworkConfig, steps: int, limit: float) -> float:
    """Largest distance of an output from what float64 gives."""
    parameters = parameters_of(config, limit)
    network, reference = CompiledNetwork(config, parameters), in_double(config, parameters)
    return max(
        float(np.abs(network.step(image) - reference.step(image.astype(np.float64))).max())
        for image in images_for(steps)
    )


@st.composite
def networks(draw: st.DrawFn) -> NetworkConfig:
    """Networks of any sizes whose kernels fit."""

    def maps(width: int, height: int) -> dict[str, object]:
        return {
            "maps": draw(st.integers(1, 4)),
            "kernel": (draw(st.integers(1, width)), draw(st.integers(1, height))),
            "stride": draw(st.integers(1, 4)),
            "tau": draw(st.floats(1, 50)),
        }

    def level() -> dict[str, object]:
        return {"units": draw(st.integers(1, 40)), "tau": draw(st.floats(1, 200))}

    def units(below: int, kernel: int, stride: int) -> int:
        return (below - kernel) // stride + 1

    fast = maps(IMAGE_WIDTH, IMAGE_HEIGHT)
    kernel_width, kernel_height = fast["kernel"]
    return NetworkConfig.model_validate(
        {
            "mstnn_fast": fast,
            "mstnn_slow": maps(
                units(IMAGE_WIDTH, kernel_width, fast["stride"]),
                units(IMAGE_HEIGHT, kernel_height, fast["stride"]),
            ),
            "pfc": level(),
            "mtrnn_slow": level(),
            "mtrnn_fast": level(),
            "softmax_units": draw(st.integers(2, 20)),
            "update_order": draw(st.sampled_from(["bottom_up", "literal"])),
        }
    )


@pytest.mark.usefixtures("_compiled")
@settings(max_examples=100, deadline=None)
@given(config=networks())
def test_any_network_agrees_with_numpy(config: NetworkConfig) -> None:
    weights = max(np.prod(shape[1:]) for shape in parameter_shapes(config).values())
    assert worst_error(config, steps=6, limit=2 / np.sqrt(weights)) < 3e-6


@pytest.mark.usefixtures("_compiled")
@pytest.mark.parametrize("order", ["bottom_up", "literal"])
def test_the_papers_network_agrees_with_numpy_in_a_whole_episode(order: str) -> None:
    config = NetworkConfig.model_validate({"update_order": order})
    assert worst_error(config, steps=130, limit=0.2) < 3e-6


@pytest.mark.usefixtures("_compiled")
def test_large_potentials_saturate() -> None:
    config = NetworkConfig()
    parameters = parameters_of(config, limit=30.0)
    network = CompiledNetwork(config, parameters)
    outputs = np.array([network.step(image) for image in images_for(20)])
    assert np.isfinite(outputs).all()
    np.testing.assert_allclose(outputs.sum(-1), 1.0, rtol=1e-5)


@pytest.mark.usefixtures("_compiled")
@pytest.mark.parametrize("order", ["bottom_up", "literal"])
def test_reset_returns_to_the_neutral_state(order: str) -> None:
    config = NetworkConfig.model_validate({"update_order": order})
    network, images = CompiledNetwork(config, parameters_of(config)), images_for(5)
    first = [network.step(image) for image in images]
    assert not np.array_equal(network.step(images[0]), first[0])
    network.reset()
    np.testing.assert_array_equal([network.step(image) for image in images], first)


@pytest.mark.usefixtures("_compiled")
def test_each_network_has_its_own_state() -> None:
    config = NetworkConfig()
    parameters, images = parameters_of(config), images_for(4)
    alone = CompiledNetwork(config, parameters)
    expected = [alone.step(image) for image in images]
    one, other = CompiledNetwork(config, parameters), CompiledNetwork(config, parameters)
    steps = []
    for image in images:
        steps.append(one.step(image))
        other.step(-image)
    del other
    gc.collect()
    np.testing.assert_array_equal(steps, expected)
    np.testing.assert_array_equal(steps[0], expected[0])


@pytest.mark.usefixtures("_compiled")
def test_wrong_sizes_are_refused() -> None:
    config = NetworkConfig()
    network = CompiledNetwork(config, parameters_of(config))
    with pytest.raises(ValueError, match="broadcast"):
        network.step(np.zeros((64, 48), np.float32))
    with pytest.raises(ValueError, match="broadcast"):
        network.act(np.zeros(7, np.float32))
    other = parameters_of(NetworkConfig(softmax_units=7))
    with pytest.raises(ValueError, match=r"outputs\.input"):
        CompiledNetwork(config, other)


@pytest.mark.usefixtures("no_compiler")
def test_without_a_compiler_numpy_acts(caplog: pytest.LogCaptureFixture) -> None:
    acting_library.cache_clear()
    try:
        config = NetworkConfig()
        for _ in range(2):
            network = make_acting_network(config, parameters_of(config))
            assert isinstance(network, NumpyNetwork)
    finally:
        acting_library.cache_clear()
    assert len([line for line in caplog.messages if "no C++ compiler" in line]) == 1
