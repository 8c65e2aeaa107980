"""Brings what a person did, at the person's own pace, to the steps of a task's phases."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.motion import minimum_jerk
from proto.body import ACTION_SIZE, ARM, FOCUS, GRASP, NECK

Array = NDArray[np.float64]

MOVING: Final = 0.8
"""Share of a phase in which the robot moves; in the rest it comes to rest."""
LEVEL_DEG: Final = 5.0
"""A movement of the hand or of the focus by one level takes as long as one by so many degrees."""

_WEIGHTS: Final = np.ones(ACTION_SIZE)
_WEIGHTS[[GRASP, FOCUS]] = LEVEL_DEG
_PARTS: Final = (
    [*range(*ARM.indices(ACTION_SIZE)), GRASP],
    [*range(*NECK.indices(ACTION_SIZE)), FOCUS],
)
"""Arm and hand move at the same time as neck and focus, as in the tutor's plans."""


def resample(
    actions: Array, phases: Sequence[int], durations: Sequence[int], start: Array
) -> Array:
    """Return the actions (T, 11) of an episode that goes the same way as a person did.

    In each phase arm and hand go along the path that the person commanded, in the same order, with
    a minimum-jerk profile; so do neck and focus. How long the person took, and waited, is left out.

    Args:
        actions: (N, 11) what the person commanded.
        phases: (N,) the phase of each of these commands, never decreasing.
        durations: number of control steps of each phase.
        start: (11,) the action of the start posture.
    """
    at, resampled = start, []
    for phase, steps in enumerate(durations):
        way = np.vstack([at, actions[np.asarray(phases, dtype=int) == phase]])
        shares = minimum_jerk(np.arange(1, steps + 1) / max(round(MOVING * steps), 1))
        rows = np.empty((steps, ACTION_SIZE))
        for part in _PARTS:
            rows[:, part] = _along(way[:, part], shares, _WEIGHTS[part])
        resampled.append(rows)
        at = way[-1]
    return np.concatenate(resampled)


def _along(way: Array, shares: Array, weights: Array) -> Array:
    """Return the points (T, K) at shares (T,) of the length of a way (N, K)."""
    lengths = np.linalg.norm(np.diff(way, axis=0) * weights, axis=1)
    moved = np.concatenate([[True], lengths > 0.0])  # points must differ to interpolate
    far = np.concatenate([[0.0], np.cumsum(lengths)])[moved]
    points = way[moved]
    return np.stack([np.interp(shares * far[-1], far, column) for column in points.T], axis=1)
