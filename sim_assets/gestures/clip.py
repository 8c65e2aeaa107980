"""The form of a clip, and the two sides of its pictures."""

from __future__ import annotations

from typing import Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Clip = NDArray[np.uint8]
"""Grey pictures (FRAMES, SIZE, SIZE) uint8, row 0 at the top."""
Side = Literal["picture-left", "picture-right"]
"""Where in the picture the person points, as seen by whoever watches the clip."""

SIDES: Final[tuple[Side, ...]] = ("picture-left", "picture-right")
FRAMES: Final = 40
SIZE: Final = 96
"""Width and height of a clip's pictures in pixels."""


class GestureLibrary(Protocol):
    """Clips by side, subject and take.

    Attributes:
        subjects: names of the persons.
        takes: names of the recordings; every subject has each of them for both sides.
    """

    subjects: tuple[str, ...]
    takes: tuple[str, ...]

    def clip(self, side: Side, subject: str, take: str) -> Clip:
        """The clip of one subject and take.

        Raises:
            ValueError: the library has no such subject or take.
        """
