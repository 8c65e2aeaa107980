"""The two cameras that every backend shows: the robot's left eye, and one outside the scene.

Everything here is independent of the simulator: where a camera stands, how wide it sees, how
rendered pixels are averaged, and how colours become the grey picture that the network sees.

A *rendered picture* is an array (height, width, 4) uint8. Where a body is seen, it holds the sRGB
colour and 255; elsewhere all four values are 0. `colours` and `grey` fill in the sky.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from actors.simulator import EYE_HEIGHT, Array, Crop, Image
from proto.body import IMAGE_HEIGHT, IMAGE_WIDTH

NEAR_M: Final = 0.01
"""What is nearer to a camera is not drawn."""
FAR_M: Final = 5.0
"""What is farther from a camera is not drawn."""

EYE_FOV_DEG: Final = 50.0
"""Vertical field of view of the whole eye image."""
SUPERSAMPLING: Final = 3
"""Rendered pixels along each side of one pixel of the network's picture."""
SUPERSAMPLED_SIZE: Final = (SUPERSAMPLING * IMAGE_WIDTH, SUPERSAMPLING * IMAGE_HEIGHT)
"""Width and height of the rendered picture that `grey` takes."""

OUTSIDE_PLACE_M: Final = (-0.7, 1.0, 0.55)
"""Where the outside camera stands (world frame): at the robot's left front, a little above it."""
OUTSIDE_TARGET_M: Final = (0.09, 0.12, 0.11)
"""Which point the outside camera looks at (world frame)."""
OUTSIDE_FOV_DEG: Final = 52.0
"""Vertical field of view of the outside camera."""
OUTSIDE_SUPERSAMPLING: Final = 2
"""Rendered pixels along each side of one pixel of the picture from outside."""

SKY: Final = 102.0
"""Grey of what lies beyond all bodies: lighter than the hand, darker than the table."""
LUMA: Final = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in a grey value (Rec. 601)."""
# The fourth weight takes the sky away again where a body is seen.
_GREY_WEIGHTS: Final = np.array([*LUMA, -SKY / 255.0], dtype=np.float32)


def focal_length(fov_deg: float, pixels: int) -> float:
    """Focal length, in pixels, of a camera whose field of view spans that many pixels."""
    return pixels / 2 / math.tan(math.radians(fov_deg / 2))


_EYE_FOCAL_LENGTH: Final = focal_length(EYE_FOV_DEG, EYE_HEIGHT)


def eye_focal_lengths(crop: Crop, width: int, height: int) -> tuple[float, float]:
    """Focal lengths (across, down) with which the eye sees `crop` on width x height pixels."""
    return (_EYE_FOCAL_LENGTH * width / crop.width, _EYE_FOCAL_LENGTH * height / crop.height)


def outside_focal_lengths(height: int) -> tuple[float, float]:
    """Focal lengths (across, down) of the outside camera for a picture of that height."""
    focal = focal_length(OUTSIDE_FOV_DEG, height)
    return (focal, focal)


def outside_pose() -> Array:
    """Pose (4, 4) of the outside camera in the world frame: x forward, y left, z up."""
    return looking_at(OUTSIDE_PLACE_M, OUTSIDE_TARGET_M)


def looking_at(place_m: Sequence[float], target_m: Sequence[float]) -> Array:
    """Pose (4, 4) at a place, x towards a target that is not straight above or below, z upwards."""
    x = np.subtract(target_m, place_m)
    x /= np.linalg.norm(x)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
    matrix[:3, 3] = place_m
    return matrix


def averaged(fine: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Mean of a picture (H, W, C) over blocks of factor x factor pixels, uint8."""
    size = (fine.shape[1] // factor, fine.shape[0] // factor)
    return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def grey(rendered: Image) -> Image:
    """The network's picture (48, 64) uint8 of a rendered picture of SUPERSAMPLED_SIZE."""
    picture = averaged(rendered, SUPERSAMPLING)
    return np.asarray(np.rint(picture @ _GREY_WEIGHTS + SKY), dtype=np.uint8)


def colours(rendered: Image) -> Image:
    """Colours (height, width, 3) uint8 of a rendered picture, with the sky behind the bodies."""
    sky = SKY * (1.0 - rendered[..., 3:] / 255.0)
    return np.asarray(np.rint(rendered[..., :3] + sky), dtype=np.uint8)


def black() -> Image:
    """The network's picture (48, 64) uint8 where nothing is rendered."""
    return np.zeros((IMAGE_HEIGHT, IMAGE_WIDTH), dtype=np.uint8)
