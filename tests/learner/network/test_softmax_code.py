from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from learner.network.softmax_code import SoftmaxCode
from proto.body import ACTION_SIZE, ACTION_VALUES
from proto.config import NetworkConfig

LOWEST = np.array([value.minimum for value in ACTION_VALUES])
HIGHEST = np.array([value.maximum for value in ACTION_VALUES])
FRACTIONS = st.lists(st.floats(0, 1), min_size=ACTION_SIZE, max_size=ACTION_SIZE)


@given(FRACTIONS, FRACTIONS, FRACTIONS)
def test_decoding_inverts_encoding(
    one: list[float], other: list[float], between: list[float]
) -> None:
    ends = LOWEST + (HIGHEST - LOWEST) * np.array([one, other])
    code = SoftmaxCode.of_actions(ends, NetworkConfig())
    values = ends[0] + (ends[1] - ends[0]) * np.array(between)
    outputs = code.encode(values)
    assert outputs.dtype == np.float32
    np.testing.assert_allclose(outputs.sum(-1), 1, atol=1e-5)
    error = np.abs(code.decode(outputs) - values)
    # below 0.1 degree for every range up to 160 degrees, wider than any that is tutored
    assert (error <= 0.0006 * (code.maxima - code.minima) + 1e-4).all()


def test_values_outside_the_range_are_coded_as_its_end() -> None:
    code = SoftmaxCode.of_ranges(LOWEST / 2, HIGHEST / 2, NetworkConfig())
    np.testing.assert_array_equal(code.encode(HIGHEST), code.encode(HIGHEST / 2))
    np.testing.assert_array_equal(code.encode(LOWEST - 50), code.encode(LOWEST / 2))


def test_decoded_actions_are_within_the_robots_limits() -> None:
    code = SoftmaxCode.of_ranges(LOWEST, HIGHEST, NetworkConfig())
    last_unit_only = np.zeros((ACTION_SIZE, 10))
    last_unit_only[:, -1] = 1
    assert (code.references[:, -1] > HIGHEST).all()
    np.testing.assert_array_equal(code.decode(last_unit_only), HIGHEST)
    np.testing.assert_array_equal(code.decode(last_unit_only[:, ::-1]), LOWEST)


def test_a_value_that_never_changes_can_be_coded() -> None:
    still = (LOWEST + HIGHEST) / 2
    code = SoftmaxCode.of_actions(np.stack([still, still]), NetworkConfig())
    assert (code.maxima > code.minima).all()
    np.testing.assert_allclose(code.decode(code.encode(still)), still, atol=1e-3)


@pytest.mark.parametrize("units", [2, 5, 30])
def test_number_of_units_comes_from_the_config(units: int) -> None:
    code = SoftmaxCode.of_ranges(LOWEST, HIGHEST, NetworkConfig(softmax_units=units))
    assert code.encode(np.zeros((7, ACTION_SIZE))).shape == (7, ACTION_SIZE, units)


def test_margin_and_width_are_as_configured() -> None:
    code = SoftmaxCode.of_ranges(
        LOWEST, HIGHEST, NetworkConfig(code_margin=0.5, code_width=0.25, softmax_units=5)
    )
    spacing = 2 * (HIGHEST - LOWEST) / 4
    np.testing.assert_allclose(code.references[:, 0], LOWEST - 0.5 * (HIGHEST - LOWEST))
    np.testing.assert_allclose(np.diff(code.references)[:, 1], spacing)
    outputs = code.encode(code.references[:, 2])
    np.testing.assert_allclose(outputs[:, 1] / outputs[:, 2], np.exp(-0.5 / 0.25**2), rtol=1e-5)
