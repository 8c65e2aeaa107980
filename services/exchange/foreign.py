"""Makes tutoring sequences of what others have recorded, without situation and outcome."""

from __future__ import annotations

import hashlib
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from actors.attention import targets_of_action
from actors.backends.robot import motors_of
from proto.body import IMAGE_HEIGHT, IMAGE_WIDTH
from proto.episode import STEPS, UNKNOWN_OUTCOME, Episode, Floats, Image, Kind
from proto.errors import UserError

MOST_STEPS: Final = STEPS.most
LARGEST_SIDE: Final = 4096
"""Of a picture, in pixels."""
FASTEST: Final = 1000.0
"""Steps per second, at most."""


def foreign_episode(
    images: Image, targets: Floats, *, task: str, origin: str, fps: float
) -> Episode:
    """Make a tutoring sequence; the same data always get the same id.

    Args:
        images: (T, 48, 64) uint8, made by `eye_picture`.
        targets: (T, 11) the actions.
        task: name of the task that it shows.
        origin: name of the format that it comes from.
        fps: steps per second.

    Raises:
        UserError: it has no step, or too many, or its rate is impossible.
    """
    if not 1 <= len(targets) <= MOST_STEPS:
        raise UserError(
            f"a sequence has {len(targets)} steps; 1 to {MOST_STEPS} are possible: divide it"
        )
    if not 0.0 < fps <= FASTEST:
        raise UserError(f"{fps} steps per second; more than 0 and at most {FASTEST:g} are possible")
    digest = hashlib.sha256(images.tobytes() + targets.tobytes()).hexdigest()
    joints = np.stack([motors_of(targets_of_action(row)) for row in targets.astype(np.float64)])
    return Episode(
        id=digest[:32],
        kind=Kind.TUTORING,
        task=task,
        situation={},
        seed=0,
        actor="import",
        backend="unknown",
        policy=origin,
        policy_version=0,
        config_digest="",
        images=images,
        actions=targets,
        targets=targets,
        joints_deg=joints.astype(np.float32),
        phase_names=("whole sequence",),
        phases=np.zeros(len(targets), dtype=np.uint8),
        body_names=(),
        body_poses=np.zeros((len(targets), 0, 7), dtype=np.float32),
        outcome=UNKNOWN_OUTCOME,
        control_period_s=1.0 / fps,
    )


def eye_picture(picture: NDArray[np.uint8]) -> Image:
    """Scale the largest part in the middle of an RGB picture that is 4:3 to the eye's grey one.

    Raises:
        ValueError: the picture is empty or too large.
    """
    check_picture(*picture.shape[:2])
    height, width = picture.shape[:2]
    across = min(width, round(height * IMAGE_WIDTH / IMAGE_HEIGHT))
    down = min(height, round(width * IMAGE_HEIGHT / IMAGE_WIDTH))
    left, top = (width - across) // 2, (height - down) // 2
    middle = np.ascontiguousarray(picture[top : top + down, left : left + across])
    grey = cv2.cvtColor(middle, cv2.COLOR_RGB2GRAY)
    size = (IMAGE_WIDTH, IMAGE_HEIGHT)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def check_picture(height: int, width: int) -> None:
    """Refuse the size of a picture before it is decoded.

    Raises:
        ValueError: it is empty or too large.
    """
    if not (1 <= height <= LARGEST_SIDE and 1 <= width <= LARGEST_SIDE):
        raise ValueError(
            f"a picture of {width} x {height} pixels; 1 to {LARGEST_SIDE} are possible on each side"
        )
