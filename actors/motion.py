"""Movement profiles, interpolation of postures, and execution noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from proto.body import ACTION_SIZE, ARM, NECK

Array = NDArray[np.float64]


def minimum_jerk(fraction: Array | float) -> Array:
    """Return the position 0..1 of a minimum-jerk movement (Flash & Hogan 1985).

    Args:
        fraction: elapsed fraction 0..1 of the movement's duration; values outside are clipped.
    """
    s = np.clip(fraction, 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s * s))


def ramp(total: int, start: int, length: int) -> Array:
    """Return a minimum-jerk ramp (total,) from 0 to 1.

    It is 0 before step `start` and 1 from step `start + length - 1` on.
    """
    return minimum_jerk((np.arange(total) + 1 - start) / length)


def interpolate_postures(postures: Sequence[Array], fraction: Array | float) -> Array:
    """Interpolate postures with a cubic spline.

    Args:
        postures: at least two postures, each (7,), evenly spaced along the path.
        fraction: (...) fractions 0..1 of the path.

    Returns:
        (..., 7) the postures at these fractions.
    """
    spline = CubicSpline(np.linspace(0.0, 1.0, len(postures)), np.stack(postures))
    return np.asarray(spline(fraction))


def move_through(postures: Sequence[Array], moving: int, total: int) -> Array:
    """Return a movement (total, 7) through postures with a minimum-jerk profile, followed by rest.

    Args:
        postures: at least two postures, each (7,).
        moving: control steps of the movement.
        total: control steps of movement and rest.
    """
    return interpolate_postures(postures, minimum_jerk(np.arange(1, total + 1) / moving))


def execution_noise(steps: int, seed: int, amplitude_deg: float, correlation_steps: float) -> Array:
    """Return smooth Gaussian noise (T, 11) for actions.

    Neck and arm have noise, which fades in from zero. Grasp and focus have none.

    Args:
        steps: number of control steps T.
        seed: seed of the noise.
        amplitude_deg: standard deviation of the noise (degrees).
        correlation_steps: correlation time of the noise (control steps).
    """
    random = np.random.default_rng(seed)
    noise = np.zeros((steps, ACTION_SIZE))
    joints = np.r_[NECK, ARM]
    margin = int(4 * correlation_steps)
    white = random.standard_normal((steps + 2 * margin, len(joints)))
    smooth = gaussian_filter1d(white, correlation_steps / np.sqrt(2), axis=0)
    smooth /= np.sqrt(1.0 / (2.0 * np.sqrt(np.pi) * correlation_steps / np.sqrt(2)))
    fade_in = minimum_jerk((np.arange(steps) + 1) / correlation_steps)[:, None]
    noise[:, joints] = amplitude_deg * smooth[margin : margin + steps] * fade_in
    return noise
