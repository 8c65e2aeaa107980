"""The history of a run: samples in `metrics.jsonl` in the run's folder, one a line.

The file stays small however long a run lasts. When it is full, of all samples that lie near each
other in time only the last is kept, and from then on samples are taken more rarely.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Final

from proto.codec import MEBIBYTE, MessageError
from proto.errors import UserError
from proto.metrics import EpochMetrics
from proto.storage import append_line, drop_unfinished_line, written_whole
from services.monitoring.sample import Sample, ScoreSample

LOG = logging.getLogger(__name__)

MOST_BYTES: Final = 8 * MEBIBYTE
"""Size of a full file: about seven hours of samples that are a second apart."""
_MOST_WAITING: Final = 1000
"""So many samples wait for a disk that is full; the oldest are dropped."""
_SCORES_KEPT: Final = 5000
"""A sample that stands for several holds so many scores, the newest."""


def history_file(run_folder: Path) -> Path:
    """Where a run keeps its history."""
    return run_folder / "metrics.jsonl"


@dataclass(frozen=True)
class PastSamples:
    """A history that was read.

    Attributes:
        samples: the samples, oldest first.
        damaged: number of lines that could not be read.
    """

    samples: list[Sample]
    damaged: int


def read_history(path: Path) -> PastSamples:
    """Read a history. What cannot be read is left out, such as a last line that was cut off.

    Raises:
        UserError: the file cannot be read.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    samples, damaged = [], 0
    for line in content.splitlines():
        try:
            samples.append(Sample.of_line(line))
        except MessageError:
            damaged += 1
    return PastSamples(samples, damaged)


class History:
    """Appends samples to a file. Only one process may write to it."""

    def __init__(self, path: Path, *, period_s: float, most_bytes: int = MOST_BYTES) -> None:
        """Open a history, or begin one.

        Args:
            path: the file.
            period_s: least time between two samples (s), as long as the file was never full.
            most_bytes: size at which the file is full.

        Raises:
            StorageError: a last line that was cut off cannot be removed.
        """
        self._path = path
        self._spacing_s = period_s
        self._most_bytes = most_bytes
        self._last = -1
        self._waiting: list[Sample] = []
        drop_unfinished_line(path)

    def is_due(self, time_s: float) -> bool:
        """Whether a sample of this moment (Unix time, s) is to be added."""
        return self._slot(time_s) != self._last

    def add(self, sample: Sample) -> None:
        """Add a sample. It is on disk after the next `flush`."""
        self._last = self._slot(sample.time_s)
        self._waiting = [*self._waiting[-_MOST_WAITING + 1 :], sample]

    def flush(self) -> None:
        """Write all samples to disk, and make room if the file is full.

        Raises:
            StorageError: it cannot be written; the samples wait for the next `flush`.
        """
        if not self._waiting:
            return
        append_line(self._path, b"".join(sample.line() for sample in self._waiting))
        self._waiting = []
        if self._path.stat().st_size > self._most_bytes:
            self._make_room()

    def _slot(self, time_s: float) -> int:
        return math.floor(time_s / self._spacing_s)

    def _make_room(self) -> None:
        """Keep fewer samples, so that the file is at most half full."""
        samples = read_history(self._path).samples
        while True:
            self._spacing_s *= 2
            samples = list(_one_each(samples, self._slot))
            content = b"".join(sample.line() for sample in samples)
            if len(content) <= self._most_bytes / 2 or len(samples) <= 1:
                break
        with written_whole(self._path) as stream:
            stream.write(content)
        LOG.info("%s is full: from now on a sample every %g s", self._path, self._spacing_s)


def _one_each(samples: Iterable[Sample], slot: Callable[[float], int]) -> Iterator[Sample]:
    """Yield a sample for each slot of time: the last, with the scores of all and one epoch."""
    for _, group in groupby(samples, lambda sample: slot(sample.time_s)):
        scores: dict[tuple[str, int], ScoreSample] = {}
        epochs: tuple[EpochMetrics, ...] = ()
        for sample in group:
            scores |= {(score.suite, score.version): score for score in sample.scores}
            epochs = (sample.learner.epochs if sample.learner else ())[-1:] or epochs
        learner = None if sample.learner is None else replace(sample.learner, epochs=epochs)
        yield replace(sample, learner=learner, scores=tuple(scores.values())[-_SCORES_KEPT:])
