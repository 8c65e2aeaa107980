"""TensorBoard reads what is written for it."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from proto.metrics import EpochMetrics, Stage
from proto.storage import DiskFullError
from services.monitoring.curves import Curves
from services.monitoring.event_file import FOLDER, EventFile
from services.monitoring.sample import ActorsSample, LearnerSample, Sample, ScoreSample


def read(run_folder: Path) -> EventAccumulator:
    """What TensorBoard finds in a run's folder."""
    found = EventAccumulator(str(run_folder / FOLDER))
    found.Reload()
    return found


def points(found: EventAccumulator, tag: str) -> list[tuple[int, float]]:
    return [(event.step, pytest.approx(event.value)) for event in found.Scalars(tag)]


def test_scalars_histograms_and_videos_are_read_back(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    weights = random.normal(size=(30, 20)).astype(np.float32)
    pictures = random.integers(0, 256, (5, 48, 64), dtype=np.uint8)
    events = EventFile(tmp_path, "recorder")
    events.scalar("loss/coupled", 0.25, step=3, time_s=1000.0)
    events.histogram("weights/a", weights, step=1, time_s=1001.0)
    events.histogram("weights/zeros", np.zeros(4, np.float32), step=1, time_s=1001.0)
    events.flush()
    events.video("failure/unlearned", pictures, fps=10.0, step=2, time_s=1002.0)
    events.flush()
    found = read(tmp_path)
    assert [(e.wall_time, e.step, e.value) for e in found.Scalars("loss/coupled")] == [
        (1000.0, 3, 0.25)
    ]
    (told,) = found.Histograms("weights/a")
    assert told.histogram_value.num == weights.size
    assert told.histogram_value.min == pytest.approx(weights.min())
    assert sum(told.histogram_value.bucket) == weights.size
    inside = np.searchsorted(np.sort(weights.ravel()), told.histogram_value.bucket_limit, "right")
    assert np.abs(np.cumsum(told.histogram_value.bucket) - inside).max() <= 1  # ends of buckets
    (film,) = found.Images("failure/unlearned")
    assert (film.step, film.width, film.height) == (2, 192, 144)
    assert np.array_equal(frames(film.encoded_image_string), pictures)


def frames(gif: bytes) -> np.ndarray:
    """Grey pictures of a GIF, reduced to the pixels that were enlarged."""
    with av.open(io.BytesIO(gif)) as container:
        shown = [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    return np.stack(shown)[:, 1::3, 1::3]


def sample(*epochs: int, stage: Stage = Stage.COUPLED, **given: Any) -> Sample:
    done = tuple(
        EpochMetrics(stage=stage, epoch=epoch, loss=1.0 / epoch, learning_rate=0.001 * epoch)
        for epoch in epochs
    )
    learner = LearnerSample(
        training="t",
        stage=stage,
        round=0,
        epochs=done,
        epochs_per_s=4.0,
        sequences=45,
        policy_version=1,
    )
    return Sample(time_s=1000.0, learner=learner, **given)


def counted(version: int, trials: int, strict: int) -> ScoreSample:
    return ScoreSample(
        suite="unlearned", version=version, trials=trials, lenient=trials, strict=strict, precise=0
    )


def test_samples_become_curves(tmp_path: Path) -> None:
    events = EventFile(tmp_path, "recorder")
    curves = Curves(events)
    actors = ActorsSample(present=2, steps_per_s=160.0, episodes_per_s=1.5)
    wanted = {"unlearned": 4}
    curves.add(sample(29, 30, stage=Stage.PRETRAINING), wanted)
    curves.add(sample(1, actors=actors), wanted)
    curves.add(sample(2, scores=(counted(1, 1, 1),)), wanted)
    curves.add(sample(3, 4, scores=(counted(1, 2, 1),)), wanted)
    curves.add(sample(scores=(counted(2, 3, 3),)), wanted)
    curves.add(sample(5, 6, scores=(counted(2, 4, 3),)), wanted)
    events.flush()
    found = read(tmp_path)
    assert points(found, "loss/pretraining") == [(29, 1 / 29), (30, 1 / 30)]
    assert points(found, "loss/coupled") == [(n, 1 / n) for n in (1, 2, 3, 4, 5, 6)]
    assert points(found, "learning_rate/coupled")[-1] == (6, 0.006)
    assert [value for _, value in points(found, "rates/steps_per_s")] == [160.0]
    # version 1 was given up after two trials, version 2 has all four
    assert points(found, "success_unlearned/strict") == [(1, 0.5), (2, 0.75)]


def test_a_full_disk_loses_no_event(tiny_disk: Path) -> None:
    events = EventFile(tiny_disk, "recorder")
    filler = tiny_disk / "filler"
    filler.write_bytes(bytes(60 * 1024))
    for step in range(200):
        events.scalar("loss/coupled", 1.0, step=step, time_s=1000.0)
    with pytest.raises(DiskFullError):
        events.flush()
    filler.unlink()
    events.flush()
    assert [step for step, _ in points(read(tiny_disk), "loss/coupled")] == list(range(200))


def test_the_score_of_another_suite_is_its_own_curve(tmp_path: Path) -> None:
    events = EventFile(tmp_path, "recorder")
    other = replace(counted(7, 4, 1), suite="beyond")
    Curves(events).add(sample(1, scores=(counted(7, 4, 4), other)), {"unlearned": 4, "beyond": 4})
    events.flush()
    assert points(read(tmp_path), "success_beyond/strict") == [(7, 0.25)]
