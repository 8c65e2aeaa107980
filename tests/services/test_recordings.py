"""The oldest practice is deleted when there are too many recordings, and never a trial."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from proto.config import KeepConfig
from proto.episode import Episode, Kind
from proto.recordings.episodes import write_episode
from services.recordings import GIB, Recordings

MakeEpisode = Callable[..., Episode]


@pytest.fixture
def record(make_episode: MakeEpisode, tmp_path: Path) -> Callable[[str, Kind], Path]:
    """Return a function that writes a recording, each an hour later than the one before."""
    hours = 0

    def write(name: str, kind: Kind) -> Path:
        nonlocal hours
        path = tmp_path / f"{name}.mcap"
        write_episode(path, make_episode(10, id=name, kind=kind))
        hours += 1
        os.utime(path, (hours * 3600, hours * 3600))
        return path

    return write


def names(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.iterdir())


def test_practice_beyond_its_number_is_deleted_the_oldest_first(
    tmp_path: Path, record: Callable[[str, Kind], Path]
) -> None:
    for name in ("z", "y", "x"):  # before the start, the oldest first
        record(name, Kind.PRACTICE)
    record("trial", Kind.TRIAL)
    (tmp_path / "left.mcap.0123.part").touch()
    recordings = Recordings(tmp_path, KeepConfig(practice=2))
    assert names(tmp_path) == ["trial", "x", "y"]
    recordings.add(record("new", Kind.PRACTICE), Kind.PRACTICE)
    recordings.add(record("trial2", Kind.TRIAL), Kind.TRIAL)
    assert names(tmp_path) == ["new", "trial", "trial2", "x"]
    assert recordings.deleted == 2


def test_a_full_allowance_takes_all_practice_but_no_trial(
    tmp_path: Path, record: Callable[[str, Kind], Path], caplog: pytest.LogCaptureFixture
) -> None:
    size = record("trial", Kind.TRIAL).stat().st_size
    recordings = Recordings(tmp_path, KeepConfig(gib=2.5 * size / GIB))
    recordings.add(record("practice", Kind.PRACTICE), Kind.PRACTICE)
    assert names(tmp_path) == ["practice", "trial"]
    for name in ("trial2", "trial3"):
        recordings.add(record(name, Kind.TRIAL), Kind.TRIAL)
    assert names(tmp_path) == ["trial", "trial2", "trial3"]
    assert "trials are never deleted" in caplog.text


def test_a_damaged_recording_is_kept_and_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "damaged.mcap").write_bytes(b"nothing")
    Recordings(tmp_path, KeepConfig(practice=0))
    assert names(tmp_path) == ["damaged"]
    assert "damaged.mcap is damaged" in caplog.text
