"""The light that every backend draws with; it never changes.

In the picture from outside the sun casts shadows. In the eye's pictures, which the network sees,
nothing does.

A surface whose normal is n (unit vector, world frame) and whose colour is c (linear, 0..1) is seen
in the sRGB colour (brightness(n) * c) ** (1 / GAMMA).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from actors.simulator import Array

TO_SUN: Final = (-0.26, -0.43, 0.865)
"""Direction to the sun: behind the robot's left shoulder."""
SUN: Final = 0.4
"""Brightness that the sun adds to a surface that faces it."""
SKY: Final = 0.55
"""Brightness of a surface that faces upwards, without the sun."""
GROUND: Final = 0.35
"""Brightness of a surface that faces downwards, without the sun."""
GAMMA: Final = 2.2
"""Exponent that turns linear colours into those of a picture."""

SHADOWS_CENTRE_M: Final = (0.0, 0.0, 0.0)
"""Shadows fall within a sphere around this point (world frame)."""
SHADOWS_RADIUS_M: Final = 2.3
"""Radius of this sphere."""
SHADOW_MAP_SIZE: Final = 2048
"""Pixels along each side of the picture of what the sun sees."""


def brightness(normals: Array) -> Array:
    """Brightness (...,) of matt surfaces with unit normals (..., 3)."""
    sky = GROUND + (SKY - GROUND) * (0.5 + 0.5 * normals[..., 2])
    return np.asarray(sky + SUN * np.maximum(normals @ np.array(TO_SUN), 0.0), dtype=np.float64)
