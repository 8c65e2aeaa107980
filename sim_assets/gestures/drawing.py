"""Draws clips with numpy and OpenCV; a tenth of a second each."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_assets.gestures.clip import FRAMES, SIZE, Clip, Side
from sim_assets.gestures.person import Part, parts_of
from sim_assets.gestures.subject import Subject
from sim_assets.gestures.take import Take

Array = NDArray[np.float64]
Canvas = NDArray[np.uint8]

_FOCAL: Final = 1.55 * SIZE
"""Focal length of the camera in pixels."""
_FRACTION_BITS: Final = 4
"""OpenCV takes corners as integers of 1/16 pixel."""
_CORE_SHARE: Final = 0.62
"""Width of the bright core of a capsule relative to its whole width."""
_CIRCLE: Final = np.stack(
    [(np.cos(angle), np.sin(angle)) for angle in np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)]
)
_BLUR_PIXELS: Final = 0.6


def draw_clip(side: Side, subject: Subject, take: int) -> Clip:
    """Draw one clip (40, 96, 96) uint8.

    Args:
        side: where in the picture the person points.
        subject: who points.
        take: number of the recording; each take moves a little differently.
    """
    movement = Take.from_seeds(side, subject.seed, take)
    wall = _wall(subject)
    random = np.random.default_rng(movement.noise_seed)
    frames = []
    for frame in range(FRAMES):
        canvas = wall.copy()
        for part in parts_of(subject, movement, frame):
            _draw(canvas, subject, part)
        frames.append(_recorded(canvas, movement, random))
    return np.stack(frames)


def _wall(subject: Subject) -> Canvas:
    row = subject.wall + subject.wall_slope * np.linspace(-1.0, 1.0, SIZE)
    return np.tile(np.rint(row).astype(np.uint8), (SIZE, 1))


def _draw(canvas: Canvas, subject: Subject, part: Part) -> None:
    """Draw a capsule: its darker outline, then a bright core, lit from the upper left."""
    ends = (
        _projected(subject.camera_m, part.start_m, part.start_radius_m),
        _projected(subject.camera_m, part.end_m, part.end_radius_m),
    )
    outline = (centre + radius * _CIRCLE for centre, radius in ends)
    core = (
        centre + radius * (_CORE_SHARE * _CIRCLE - 0.5 * (1.0 - _CORE_SHARE))
        for centre, radius in ends
    )
    _fill(canvas, outline, part.grey * subject.shadow)
    _fill(canvas, core, part.grey)


def _projected(camera_m: Array, point_m: Array, radius_m: float) -> tuple[Array, float]:
    """Centre (2,) and radius in pixels of a ball in front of the camera."""
    scale = _FOCAL / (camera_m[2] - point_m[2])
    x, y = point_m[:2] - camera_m[:2]
    return SIZE / 2 + scale * np.array([x, -y]), scale * radius_m


def _fill(canvas: Canvas, circles: Iterable[Array], grey: float) -> None:
    """Fill the convex hull of circles, each given as points (N, 2) in pixels."""
    hull = cv2.convexHull(np.concatenate(list(circles)).astype(np.float32))
    corners = np.rint(hull * 2**_FRACTION_BITS).astype(np.int32)
    cv2.fillConvexPoly(canvas, corners, float(grey), cv2.LINE_AA, _FRACTION_BITS)


def _recorded(canvas: Canvas, take: Take, random: np.random.Generator) -> Canvas:
    """The picture (96, 96) as a camera records it: a little blurred, with light and noise."""
    blurred = cv2.GaussianBlur(canvas.astype(np.float32), (0, 0), _BLUR_PIXELS)
    noisy = blurred + take.light + random.normal(0.0, take.noise, canvas.shape)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


class DrawnGestures:
    """Clips that are drawn when they are asked for; see `GestureLibrary`.

    Subjects and takes are named by their seeds, "0", "1" and so on. Names beyond the listed ones
    are drawn too: they serve to test with persons and recordings that nobody learned from.
    """

    def __init__(self, subjects: int, takes: int) -> None:
        """List the first `subjects` subjects with `takes` takes for each side."""
        self.subjects = tuple(str(seed) for seed in range(subjects))
        self.takes = tuple(str(seed) for seed in range(takes))

    def clip(self, side: Side, subject: str, take: str) -> Clip:
        """Draw the clip of a subject and take.

        Raises:
            ValueError: a name is not a whole number of at least 0.
        """
        return _drawn(side, _seed(subject), _seed(take))


@functools.lru_cache(maxsize=1)
def _drawn(side: Side, subject: int, take: int) -> Clip:
    """Draw a clip, which cannot be written to; an actor asks twice for each: to check, to play."""
    clip = draw_clip(side, Subject.from_seed(subject), take)
    clip.flags.writeable = False
    return clip


def _seed(name: str) -> int:
    if not (name.isascii() and name.isdigit()):
        raise ValueError(f"drawn subjects and takes are named 0, 1, 2, ...; got {name!r}")
    return int(name)
