"""Clips from a folder of videos of the user's own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_assets.gestures.clip import FRAMES, SIDES, SIZE, Clip, Side

SUBJECT: Final = "recorded"
"""Name of the one subject of a folder of videos."""
FEWEST_FRAMES: Final = 8


class GestureVideoError(ValueError):
    """A folder of videos cannot be used; the message says which file, why, and what to do."""


class RecordedGestures:
    """Clips of a folder of videos; see `GestureLibrary`.

    The folder has two subfolders, `picture-left` and `picture-right`, of videos that OpenCV can
    read. Take N is the video number N of each subfolder, in the order of their names, from 0. If
    one side has more videos than the other, those beyond the other's number are not used.
    """

    def __init__(self, folder: Path) -> None:
        """Read all videos.

        Raises:
            GestureVideoError: the folder or a side is missing or empty, or a video cannot be used.
        """
        if not folder.is_dir():
            raise GestureVideoError(f"{folder}: there is no such folder of gesture videos")
        self._clips = {side: [read_clip(path) for path in _videos(folder, side)] for side in SIDES}
        fewest = min(len(clips) for clips in self._clips.values())
        self.subjects: tuple[str, ...] = (SUBJECT,)
        self.takes = tuple(str(number) for number in range(fewest))

    def clip(self, side: Side, subject: str, take: str) -> Clip:
        """The clip of a take.

        Raises:
            ValueError: there is no such subject or take.
        """
        if subject != SUBJECT or take not in self.takes:
            raise ValueError(
                f"the folder has subject {SUBJECT!r} with takes {', '.join(self.takes)};"
                f" got subject {subject!r}, take {take!r}"
            )
        return self._clips[side][int(take)]


def read_clip(path: Path) -> Clip:
    """Read a video of any length and size as a clip (40, 96, 96) uint8.

    The frames are chosen evenly from first to last. The whole picture is scaled to the square, so
    a wide video is squeezed: cut it to a square first where that matters.

    Raises:
        GestureVideoError: the file is no readable video, or has fewer than 8 frames.
    """
    frames = _grey_frames(path)
    if not frames:
        raise GestureVideoError(
            f"{path}: cannot be read as a video; use one that OpenCV reads (such as MP4 with"
            " H.264), and keep other files out of this folder"
        )
    if len(frames) < FEWEST_FRAMES:
        raise GestureVideoError(
            f"{path}: has {len(frames)} frames, a gesture needs at least {FEWEST_FRAMES}"
        )
    chosen = np.rint(np.linspace(0, len(frames) - 1, FRAMES)).astype(int)
    return np.stack([frames[number] for number in chosen])


def _videos(folder: Path, side: Side) -> Sequence[Path]:
    """The files of one side, hidden ones left out, in the order of their names."""
    subfolder = folder / side
    if not subfolder.is_dir():
        raise GestureVideoError(
            f"{folder}: has no subfolder {side}; put the videos of a person who points to that"
            " side of the picture there"
        )
    paths = sorted(
        path for path in subfolder.iterdir() if path.is_file() and not path.name.startswith(".")
    )
    if not paths:
        raise GestureVideoError(f"{subfolder}: holds no video; put at least one there")
    return paths


def _grey_frames(path: Path) -> list[NDArray[np.uint8]]:
    """All frames (96, 96) of a video; empty if it cannot be read."""
    capture = cv2.VideoCapture(str(path))
    frames: list[NDArray[np.uint8]] = []
    try:
        while True:
            read, picture = capture.read()
            if not read:
                return frames
            grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
            small = cv2.resize(grey, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
            frames.append(np.asarray(small, dtype=np.uint8))
    finally:
        capture.release()
