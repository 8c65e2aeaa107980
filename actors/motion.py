"""Timing of movements, curves through postures, and noise on executed actions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from proto.body import ACTION_SIZE, ARM, NECK

Array = NDArray[np.float64]


def minimum_jerk(share: Array | float) -> Array:
    """Position 0..1 of a minimum-jerk movement at a share 0..1 of its time (Flash & Hogan 1985)."""
    s = np.clip(share, 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s * s))


def ramp(total: int, start: int, length: int) -> Array:
    """Minimum-jerk step (total,): 0 before step `start`, 1 from step `start + length - 1` on."""
    return minimum_jerk((np.arange(total) + 1 - start) / length)


def travel(postures: Sequence[Array], share: Array | float) -> Array:
    """Cubic spline through postures, each (7,), evenly spaced over shares 0..1; (..., 7)."""
    spline = CubicSpline(np.linspace(0.0, 1.0, len(postures)), np.stack(postures))
    return np.asarray(spline(share))


def execution_noise(steps: int, seed: int, amplitude_deg: float, correlation_steps: float) -> Array:
    """Smooth noise (T, 11) on neck and arm, close to zero at first; grasp and focus stay at zero.

    Args:
        steps: number of control steps T.
        seed: the same seed gives the same noise.
        amplitude_deg: its standard deviation (degrees).
        correlation_steps: its correlation time (control steps).
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
