"""What TensorBoard shows of a run: its samples as curves, and the weights of its policies."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from services.monitoring.event_file import EventFile
from services.monitoring.sample import Sample, ScoreSample


class Curves:
    """Adds samples to an event file; steps are epochs, policy versions and seconds."""

    def __init__(self, events: EventFile) -> None:
        self._events = events
        self._began_s: float | None = None
        self._incomplete: dict[str, ScoreSample] = {}

    def add(self, sample: Sample, wanted: Mapping[str, int]) -> None:
        """Add a sample.

        Args:
            sample: the sample.
            wanted: number of trials of each policy version, by suite.
        """
        self._add_training(sample)
        self._add_rates(sample)
        for score in sample.scores:
            self._add_score(score, sample.time_s, wanted.get(score.suite, 1))

    def add_weights(
        self, weights: Mapping[str, NDArray[np.generic]], *, version: int, time_s: float
    ) -> None:
        """Add the histograms of all weights of a policy version, by their names."""
        for name, values in weights.items():
            self._events.histogram(f"weights/{name}", values, step=version, time_s=time_s)

    def _add_training(self, sample: Sample) -> None:
        for epoch in sample.learner.epochs if sample.learner else ():
            for name, value in (("loss", epoch.loss), ("learning_rate", epoch.learning_rate)):
                self._scalar(f"{name}/{epoch.stage}", value, epoch.epoch, sample)

    def _add_rates(self, sample: Sample) -> None:
        if self._began_s is None:
            self._began_s = sample.time_s
        step = max(round(sample.time_s - self._began_s), 0)
        if sample.learner is not None:
            self._scalar("rates/epochs_per_s", sample.learner.epochs_per_s, step, sample)
        if sample.actors is not None:
            self._scalar("rates/steps_per_s", sample.actors.steps_per_s, step, sample)
            self._scalar("rates/episodes_per_s", sample.actors.episodes_per_s, step, sample)

    def _add_score(self, score: ScoreSample, time_s: float, wanted: int) -> None:
        """Add a score once it is complete; another one when a later version has been tried."""
        before = self._incomplete.pop(score.suite, None)
        if before is not None and before.version < score.version:
            self._success(before, time_s)
        if score.trials >= wanted:
            self._success(score, time_s)
        else:
            self._incomplete[score.suite] = score

    def _success(self, score: ScoreSample, time_s: float) -> None:
        for reading in ("lenient", "strict", "precise"):
            rate = getattr(score, reading) / max(score.trials, 1)
            tag = f"success_{score.suite}/{reading}"
            self._events.scalar(tag, rate, step=score.version, time_s=time_s)

    def _scalar(self, tag: str, value: float, step: int, sample: Sample) -> None:
        self._events.scalar(tag, value, step=step, time_s=sample.time_s)
