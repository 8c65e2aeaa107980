"""V_I: the input of the vision, from a grey image."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from proto.episode import Image

BRIGHTNESS: Final = ((np.arange(256) / 255 - 0.5) * 2).astype(np.float32)
"""The brightness of each grey value."""


def vision_input(images: Image) -> NDArray[np.float32]:
    """Grey values 0..255 (..., height, width) uint8 as brightness -1..1, float32."""
    return BRIGHTNESS.take(images)
