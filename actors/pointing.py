"""Which point of the scene is seen at a place of a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from actors.backends.eye import eye_focal_lengths, outside_focal_lengths, outside_pose
from actors.simulator import EYE_HEIGHT, EYE_WIDTH, Box, Crop, Pose
from sim_assets.icub import EYE

Array = NDArray[np.float64]
Camera = Literal["eye", "outside"]
CAMERAS: Final[tuple[Camera, ...]] = ("eye", "outside")

OUTSIDE_WIDTH: Final = 480
OUTSIDE_HEIGHT: Final = 360
"""Size of the picture from outside; other sizes of the same shape show the same."""


def point_seen(
    camera: Camera,
    across: float,
    down: float,
    boxes: Sequence[Box],
    bodies: Mapping[str, Pose],
) -> Array | None:
    """Return the nearest point (3,) of a box that a camera sees at a place of its whole picture.

    The robot itself is ignored.

    Args:
        camera: the left eye, or the one outside the scene.
        across: place from the left edge, 0, to the right edge, 1.
        down: place from the upper edge, 0, to the lower edge, 1.
        boxes: the boxes of the scene.
        bodies: poses of the boxes and of the eye's link.

    Returns:
        The point in the world frame (m); None if no box is seen there.
    """
    origin, direction = _ray(camera, across, down, bodies)
    hits = [_hit(box, bodies[box.name], origin, direction) for box in boxes]
    nearest = min((far for far in hits if far is not None), default=None)
    return None if nearest is None else origin + nearest * direction


def _ray(
    camera: Camera, across: float, down: float, bodies: Mapping[str, Pose]
) -> tuple[Array, Array]:
    """Origin (3,) and direction (3,) of what is seen at a place of a picture."""
    if camera == "eye":
        width, height = EYE_WIDTH, EYE_HEIGHT
        focal = eye_focal_lengths(Crop(), width, height)
        origin = np.array(bodies[EYE].position_m)
        axes = _rotation(bodies[EYE])
    else:
        width, height = OUTSIDE_WIDTH, OUTSIDE_HEIGHT
        focal = outside_focal_lengths(height)
        origin, axes = outside_pose()[:3, 3], outside_pose()[:3, :3]
    seen = np.array([1.0, (0.5 - across) * width / focal[0], (0.5 - down) * height / focal[1]])
    return origin, axes @ seen


def _hit(box: Box, pose: Pose, origin: Array, direction: Array) -> float | None:
    """How many times `direction` it is from the origin to a box; None if the ray misses it."""
    axes = _rotation(pose)
    start = axes.T @ (origin - np.array(pose.position_m))
    way = axes.T @ direction
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    ends = np.stack([(side * np.array(box.size_m) / 2 - start) / way for side in (-1.0, 1.0)])
    enters, leaves = float(ends.min(axis=0).max()), float(ends.max(axis=0).min())
    return enters if 0.0 < enters <= leaves else None


def _rotation(pose: Pose) -> Array:
    return np.asarray(Rotation.from_quat(pose.quaternion, scalar_first=True).as_matrix())
