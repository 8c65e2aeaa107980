"""Event files, which TensorBoard shows: scalars, histograms and short videos."""

from __future__ import annotations

import io
import time
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
from numpy.typing import NDArray
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import HistogramProto, Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from proto.codec import MEBIBYTE
from proto.storage import append

FOLDER: Final = "tensorboard"
"""Where a run's folder has its event files."""
_VERSION: Final = "brain.Event:2"
_MOST_WAITING: Final = 16 * MEBIBYTE
"""So many bytes of events wait for a disk that is full; later events are dropped."""
_BINS: Final = 50
_ENLARGED: Final = 3
"""Each pixel of a video becomes a square of so many pixels, because TensorBoard shows it small."""


class EventFile:
    """Writes a new event file into a run's folder. Used by one thread."""

    def __init__(self, run_folder: Path, writer: str) -> None:
        """Name the file; it is made by the first `flush` that has something to write.

        Args:
            run_folder: folder of the run.
            writer: name of the process, valid in a file's name.
        """
        self._path = run_folder / FOLDER / f"events.out.tfevents.{time.time():.0f}.{writer}"
        self._waiting = io.BytesIO()
        self._records = RecordWriter(self._waiting)
        self._add(Event(wall_time=time.time(), file_version=_VERSION))

    def scalar(self, tag: str, value: float, *, step: int, time_s: float) -> None:
        """Add a number.

        Args:
            tag: name of the curve; a slash separates the group from the name.
            value: the number.
            step: place on the curve.
            time_s: when it was measured, Unix time (s).
        """
        self._summary(Summary.Value(tag=tag, simple_value=value), step, time_s)

    def histogram(self, tag: str, values: NDArray[np.generic], *, step: int, time_s: float) -> None:
        """Add the histogram of an array of finite numbers; see `scalar`."""
        numbers = values.astype(np.float64).ravel()
        counts, edges = np.histogram(numbers, _BINS)
        histogram = HistogramProto(
            min=numbers.min(),
            max=numbers.max(),
            num=numbers.size,
            sum=numbers.sum(),
            sum_squares=numbers @ numbers,
            # Each bucket is told by its upper end; the first one, which is empty, begins the range.
            bucket_limit=edges.tolist(),
            bucket=[0, *counts.tolist()],
        )
        self._summary(Summary.Value(tag=tag, histo=histogram), step, time_s)

    def video(
        self, tag: str, pictures: NDArray[np.uint8], *, fps: float, step: int, time_s: float
    ) -> None:
        """Add grey pictures (N, height, width) as an animated GIF; see `scalar`."""
        large = pictures.repeat(_ENLARGED, axis=1).repeat(_ENLARGED, axis=2)
        _, height, width = large.shape
        image = Summary.Image(
            height=height, width=width, colorspace=1, encoded_image_string=_gif(large, fps)
        )
        self._summary(Summary.Value(tag=tag, image=image), step, time_s)

    def flush(self) -> None:
        """Write all events to disk.

        Raises:
            StorageError: they cannot be written; they wait for the next `flush`.
        """
        if content := self._waiting.getvalue():
            append(self._path, content)
            self._waiting.seek(0)
            self._waiting.truncate()

    def _summary(self, value: Any, step: int, time_s: float) -> None:
        self._add(Event(wall_time=time_s, step=step, summary=Summary(value=[value])))

    def _add(self, event: Any) -> None:
        if self._waiting.tell() < _MOST_WAITING:
            self._records.write(event.SerializeToString())


def _gif(pictures: NDArray[np.uint8], fps: float) -> bytes:
    """Encode grey pictures; a GIF holds 256 colours, so nothing is lost."""
    rate = Fraction(fps).limit_denominator(1000)
    stored = io.BytesIO()
    with av.open(stored, "w", format="gif") as container:
        stream = container.add_stream("gif", rate=rate)
        stream.height, stream.width = pictures[0].shape
        stream.pix_fmt = "gray"
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="gray")
            frame.pts, frame.time_base = number, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return stored.getvalue()
