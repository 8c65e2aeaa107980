"""Disturbances of the grey picture, between the simulator and the policy.

They are the same for every simulator, and for every crop of the eye image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import cv2
import numpy as np

from proto.body import IMAGE_HEIGHT, IMAGE_WIDTH
from proto.episode import Image

PictureChange = Callable[[int, Image], Image]
"""Maps a control step, from 0, and the picture (48, 64) uint8 to the picture that is seen."""
MakePictureChange = Callable[[float, np.random.Generator], PictureChange]
"""Makes the change for an episode from its strength and its random numbers."""


def _brighter(strength: float, random: np.random.Generator) -> PictureChange:  # noqa: ARG001
    return lambda _, image: _rounded(image * (1.0 + strength / 100.0))


def _darker(strength: float, random: np.random.Generator) -> PictureChange:  # noqa: ARG001
    return lambda _, image: _rounded(image * (1.0 - strength / 100.0))


def _noisy(strength: float, random: np.random.Generator) -> PictureChange:
    """Noise that is independent in all pixels and steps; the same step has the same noise."""
    seed = int(random.integers(2**32))

    def change(step: int, image: Image) -> Image:
        noise = np.random.default_rng([seed, step]).normal(0.0, strength, image.shape)
        return _rounded(image + noise)

    return change


def _blurred(strength: float, random: np.random.Generator) -> PictureChange:  # noqa: ARG001
    return lambda _, image: np.asarray(
        cv2.GaussianBlur(image, (0, 0), strength, borderType=cv2.BORDER_REPLICATE), dtype=np.uint8
    )


def _occluded(strength: float, random: np.random.Generator) -> PictureChange:
    """A square that stays at its place in the picture, like dirt on the lens."""
    width = round(strength)
    top = int(random.integers(IMAGE_HEIGHT - width + 1))
    left = int(random.integers(IMAGE_WIDTH - width + 1))

    def change(_step: int, image: Image) -> Image:
        hidden = image.copy()
        hidden[top : top + width, left : left + width] = 0
        return hidden

    return change


def _rounded(levels: np.ndarray) -> Image:
    return np.asarray(np.rint(levels).clip(0, 255), dtype=np.uint8)


PICTURE_CHANGES: Final[Mapping[str, MakePictureChange]] = {
    "brighter": _brighter,
    "darker": _darker,
    "noisy": _noisy,
    "blurred": _blurred,
    "occluded": _occluded,
}
"""How the picture changes, by the name of the disturbance."""
