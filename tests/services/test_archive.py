"""An archive finds what a run has on disk, and is not led astray by what it cannot read."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from proto.episode import Episode
from proto.errors import UserError
from proto.recordings.episodes import read_episode, read_heading, write_episode
from services.archive import OneRecording, RunArchive


def recorded(folder: Path, episode: Episode, at_s: int) -> Path:
    path = folder / f"{episode.id}.mcap"
    write_episode(path, episode)
    os.utime(path, (at_s, at_s))
    return path


def test_recordings_are_found_in_their_order(
    tmp_path: Path, make_episode: Callable[..., Episode]
) -> None:
    archive = RunArchive(tmp_path)
    archive.look()
    assert not archive.since(0)
    recorded(tmp_path / "rollouts", make_episode(3, id="second"), 200)
    recorded(tmp_path / "tutoring", make_episode(3, id="first"), 100)
    (tmp_path / "rollouts" / "broken.mcap").write_bytes(b"nothing")
    write_episode(tmp_path / "rollouts" / "id.mcap", make_episode(3, id="../escape"))
    (tmp_path / "rollouts" / "unfinished.mcap.1234.part").write_bytes(b"nothing")
    archive.look()
    assert [each.heading.id for each in archive.since(0)] == ["first", "second"]
    assert [each.heading.id for each in archive.tutored()] == ["first"]
    third = recorded(tmp_path / "rollouts", make_episode(3, id="third"), 300)
    archive.look()
    assert [each.heading.id for each in archive.since(2)] == ["third"]
    assert archive.path("third") == third
    assert archive.path("../third") is None


def test_a_heading_says_what_the_episode_says(
    tmp_path: Path, make_episode: Callable[..., Episode]
) -> None:
    path = recorded(tmp_path, make_episode(5, started_s=1.7e9), 1)
    heading, episode = read_heading(path), read_episode(path)
    for name in ("id", "kind", "task", "situation", "seed", "actor", "backend", "policy"):
        assert getattr(heading, name) == getattr(episode, name)
    assert heading.outcome == episode.outcome
    assert heading.steps == episode.steps
    assert OneRecording(path).path(episode.id) == path
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(UserError, match="damaged"):
        read_heading(path)


def test_logs_and_endings_are_told(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / "learner.log").write_text("".join(f"line {n} \x1b[2J\n" for n in range(5000)))
    (logs / "supervisord.log").write_text(
        "2026-01-01 10:00:00,000 INFO spawned: 'learner' with pid 7\n"
        "2026-01-01 10:00:01,000 INFO spawned: 'actor-1' with pid 8\n"
        "2026-01-01 10:00:02,000 WARN exited: learner (terminated by SIGKILL; not expected)\n"
        "2026-01-01 10:00:03,000 WARN exited: actor-1 (exit status 1; not expected)\n"
        "2026-01-01 10:00:04,000 INFO spawned: 'actor-1' with pid 9\n"
    )
    archive = RunArchive(tmp_path)
    told = archive.logs()
    assert list(told) == ["learner"]
    assert told["learner"][-1] == r"line 4999 \x1b[2J"
    assert len(told["learner"]) <= 12
    assert archive.endings() == {"learner": "exited: terminated by SIGKILL; not expected"}
