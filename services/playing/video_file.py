"""Writes pictures into a video that browsers play: H.264 in an MP4 file, or an animated GIF."""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Protocol

import av
import numpy as np
from av.filter import Graph
from av.video.frame import PictureType
from numpy.typing import NDArray

from proto.errors import UserError
from proto.storage import storage_errors, written_whole

Picture = NDArray[np.uint8]

QUALITY: Final = 18
"""H.264's constant rate factor; below 20 a difference is hardly seen."""
_SMALLEST_FPS: Final = 0.01


class WritePicture(Protocol):
    """Adds a picture to a video."""

    def __call__(self, picture: Picture, *, key: bool = False) -> None:
        """Add a picture; a key picture can be shown without those before it."""


class _Encoder(Protocol):
    """Encodes frames into packets."""

    def encode(self, frame: av.VideoFrame) -> Iterator[Any]:
        """Take a frame and yield the packets that are complete."""

    def flush(self) -> Iterator[Any]:
        """Yield the remaining packets."""


def check_video_name(path: Path) -> None:
    """Check that the name of a video names a format that can be written.

    Raises:
        UserError: the name ends neither in .mp4 nor in .gif.
    """
    if path.suffix not in _ENCODERS:
        raise UserError(f"{path}: the name of a video must end in .mp4 or .gif")


def video_argument(name: str) -> Path:
    """`type=` of an argument that names the video to write."""
    try:
        check_video_name(Path(name))
    except UserError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return Path(name)


@contextmanager
def video_file(out: Path, fps: float) -> Iterator[WritePicture]:
    """Open a video to write pictures (height, width, 3) uint8, RGB, to; all of the same size.

    The video is encoded in a temporary folder and copied to `out` when it is complete. An MP4 file
    holds H.264; width and height must be even. A GIF has half the width and height.

    Args:
        out: the file to write; the ending of its name, .mp4 or .gif, chooses the format.
        fps: pictures per second.

    Raises:
        UserError: the name has another ending, or the file cannot be written.
    """
    check_video_name(out)
    rate = Fraction(max(fps, _SMALLEST_FPS)).limit_denominator(1000)
    with tempfile.TemporaryDirectory() as folder:
        encoded = Path(folder) / f"video{out.suffix}"
        # The index of an MP4 file comes first, so that a browser starts before it has the whole.
        options = {"movflags": "faststart"} if out.suffix == ".mp4" else {}
        with storage_errors(encoded), av.open(str(encoded), "w", options=options) as container:
            encoder: _Encoder | None = None
            count = 0

            def write(picture: Picture, *, key: bool = False) -> None:
                nonlocal encoder, count
                if encoder is None:
                    height, width = picture.shape[:2]
                    encoder = _ENCODERS[out.suffix](container, rate, width, height)
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
                frame.pts, frame.time_base = count, 1 / rate
                if key:
                    frame.pict_type = PictureType.I
                count += 1
                container.mux(list(encoder.encode(frame)))

            yield write
            if encoder is not None:
                container.mux(list(encoder.flush()))
        with encoded.open("rb") as source, written_whole(out) as target:
            shutil.copyfileobj(source, target)


class _H264:
    """H.264 with the colours of half resolution, the only ones that every browser decodes."""

    def __init__(self, container: Any, rate: Fraction, width: int, height: int) -> None:
        # No picture depends on a later one (a B-frame): Rerun cannot show such videos.
        options = {"crf": str(QUALITY), "bf": "0", "forced-idr": "1"}
        self._stream = container.add_stream("libx264", rate=rate, options=options)
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = "yuv420p"

    def encode(self, frame: av.VideoFrame) -> Iterator[Any]:
        yield from self._stream.encode(frame)

    def flush(self) -> Iterator[Any]:
        yield from self._stream.encode(None)


class _Gif:
    """GIF with half the width and height and the best 256 colours of each picture."""

    def __init__(self, container: Any, rate: Fraction, width: int, height: int) -> None:
        self._stream = container.add_stream("gif", rate=rate)
        self._stream.width, self._stream.height = width // 2, height // 2
        self._stream.pix_fmt = "pal8"
        self._graph = Graph()
        source = self._graph.add_buffer(
            width=width, height=height, format=av.VideoFormat("rgb24"), time_base=1 / rate
        )
        small = self._graph.add("scale", f"{width // 2}:{height // 2}:flags=area")
        both = self._graph.add("split")
        palette = self._graph.add("palettegen", "stats_mode=single")
        painted = self._graph.add("paletteuse", "new=1:dither=bayer:bayer_scale=4")
        sink = self._graph.add("buffersink")
        source.link_to(small)
        small.link_to(both)
        both.link_to(painted, 0, 0)
        both.link_to(palette, 1, 0)
        palette.link_to(painted, 0, 1)
        painted.link_to(sink)
        self._graph.configure()

    def encode(self, frame: av.VideoFrame) -> Iterator[Any]:
        self._graph.push(frame)
        yield from self._painted()

    def flush(self) -> Iterator[Any]:
        self._graph.push(None)
        yield from self._painted()
        yield from self._stream.encode(None)

    def _painted(self) -> Iterator[Any]:
        while True:
            try:
                frame = self._graph.pull()
            except (av.error.BlockingIOError, av.error.EOFError):
                return
            yield from self._stream.encode(frame)


_ENCODERS: Final[dict[str, Callable[[Any, Fraction, int, int], _Encoder]]] = {
    ".mp4": _H264,
    ".gif": _Gif,
}
