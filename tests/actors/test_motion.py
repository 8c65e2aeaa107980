"""Movement profiles, interpolation of postures, and execution noise."""

import numpy as np
import pytest

from actors.motion import (
    execution_noise,
    interpolate_postures,
    minimum_jerk,
    move_through,
    ramp,
)
from proto.body import ARM, FOCUS, GRASP


def test_minimum_jerk_starts_and_ends_at_rest():
    fraction = np.linspace(-0.5, 1.5, 2001)
    position = minimum_jerk(fraction)
    assert (position[fraction <= 0] == 0.0).all()
    assert (position[fraction >= 1] == 1.0).all()
    assert (np.diff(position) >= 0.0).all()
    assert np.abs(np.diff(position, 2)).max() < 1e-4
    assert minimum_jerk(0.5) == pytest.approx(0.5)


def test_ramp_rises_between_its_start_and_its_length():
    values = ramp(20, 5, 8)
    assert (values[:5] == 0.0).all()
    assert 0.0 < values[5] < values[11] < 1.0
    assert (values[12:] == 1.0).all()


def test_interpolation_passes_each_posture_at_even_spacing():
    postures = [np.full(7, 1.0), np.arange(7.0), np.full(7, -2.0)]
    np.testing.assert_allclose(
        interpolate_postures(postures, np.array([0.0, 0.5, 1.0])), postures, atol=1e-12
    )


def test_a_movement_ends_at_its_last_posture_and_rests():
    postures = [np.full(7, 1.0), np.arange(7.0), np.full(7, -2.0)]
    movement = move_through(postures, moving=6, total=9)
    np.testing.assert_allclose(movement[2], postures[1], atol=1e-12)
    np.testing.assert_allclose(movement[5:], [postures[2]] * 4, atol=1e-12)


def test_noise_is_smooth_and_seeded_and_has_the_given_amplitude():
    noise = np.concatenate([execution_noise(124, seed, 1.0, 20.0) for seed in range(200)])
    late = noise.reshape(200, 124, 11)[:, 40:]
    assert late[..., ARM].std() == pytest.approx(1.0, abs=0.1)
    assert np.abs(np.diff(late, axis=1)).max() < 0.6
    assert (noise[..., [GRASP, FOCUS]] == 0.0).all()
    np.testing.assert_array_equal(execution_noise(50, 7, 1, 20), execution_noise(50, 7, 1, 20))
    assert np.abs(execution_noise(50, 7, 1, 20) - execution_noise(50, 8, 1, 20)).max() > 0.1
    assert (execution_noise(50, 7, 0.0, 20.0) == 0.0).all()
