"""The requested cases are recorded, and a stopped recording can be continued."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from processes import eventually

from actors.tasks.registry import make_task
from proto.config import TaskConfig
from proto.episode import Kind
from proto.errors import UserError
from proto.recordings.episodes import read_episode
from services.cli import main
from services.playing.tutoring import parse_cases

TASK = make_task(TaskConfig())
REACHING = make_task(TaskConfig(name="reaching"))
NAMES = [f"case{case:02d}_repeat{repeat:02d}.mcap" for case in (3, 41) for repeat in (0, 1)]


def record(folder: Path, *more: str) -> int:
    words = f"tutor --cases 3,41 --repeats 2 --workers 1 --out {folder}".split()
    return main([*words, *more])


def test_each_case_is_executed_clean_and_then_with_noise(recordings: Path) -> None:
    assert sorted(path.name for path in recordings.glob("*.mcap")) == NAMES
    for case in (3, 41):
        clean = read_episode(recordings / f"case{case:02d}_repeat00.mcap")
        noisy = read_episode(recordings / f"case{case:02d}_repeat01.mcap")
        assert clean.kind is Kind.TUTORING
        assert clean.situation == noisy.situation == TASK.tutored()[case]
        assert (clean.seed, noisy.seed) == (case * 1000, case * 1000 + 1)
        assert np.array_equal(clean.actions, clean.targets)
        # The target stays the clean plan: the sequence shows how to come back to it.
        assert np.allclose(noisy.targets, clean.targets, atol=1e-5)
        assert 0.2 < np.abs(noisy.actions - noisy.targets)[:, :9].mean() < 5.0
        assert clean.outcome.strict
        assert np.ptp(clean.images[-1]) > 50, "the pictures show something"


def written(path: Path) -> tuple[int, int]:
    """Tells whether a file was written again."""
    status = path.stat()
    return status.st_ino, status.st_mtime_ns


def test_a_stopped_recording_is_continued(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "stopped"
    shutil.copytree(recordings, folder)
    missing, damaged, unfinished = folder / NAMES[0], folder / NAMES[3], folder / "x.mcap.1.part"
    missing.unlink()
    damaged.write_bytes(damaged.read_bytes()[:-1000])
    unfinished.write_bytes(b"what a killed process left")
    untouched = {folder / name: written(folder / name) for name in NAMES[1:3]}
    assert record(folder) == 0
    assert "4 sequences" in capsys.readouterr().out
    assert not unfinished.exists()
    assert {path: written(path) for path in untouched} == untouched
    for path in (missing, damaged):
        again, before = read_episode(path), read_episode(recordings / path.name)
        assert np.array_equal(again.actions, before.actions)
        assert np.array_equal(again.images, before.images)


def test_a_folder_of_another_tutor_is_refused(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "other"
    shutil.copytree(recordings, folder)
    assert record(folder, "--set", "tutor.noise_deg=2.5") == 2
    assert "tutor.noise_deg = 1.0, not 2.5" in capsys.readouterr().err
    assert sorted(path.name for path in folder.glob("*.mcap")) == NAMES


@pytest.mark.parametrize(
    ("text", "cases"),
    [("all", list(range(45))), ("0,3,7", [0, 3, 7]), ("0-3", [0, 1, 2, 3]), ("7,0-1,1", [0, 1, 7])],
)
def test_cases_can_be_listed(text: str, cases: list[int]) -> None:
    task = TASK
    listed = parse_cases(text, task, seed=0)
    assert [case.number for case in listed] == cases
    assert [case.situation for case in listed] == [task.tutored()[case] for case in cases]


def test_more_random_cases_include_the_fewer_ones() -> None:
    few, more = (parse_cases(f"random:{count}", REACHING, seed=500) for count in (2, 4))
    assert more[:2] == few
    assert [case.name for case in more] == [f"random00050{i}" for i in range(4)]
    assert [case.situation for case in more] == [REACHING.sample(500 + i) for i in range(4)]


def test_random_cases_can_be_added_to_a_recording(tmp_path: Path) -> None:
    command = f"tutor --task reaching --seed 7 --repeats 2 --workers 1 --out {tmp_path}".split()
    assert main([*command, "--cases", "14"]) == 0
    assert main([*command, "--cases", "random:1"]) == 0
    recorded = sorted(tmp_path.glob("*.mcap"))
    assert [path.name for path in recorded] == [
        f"{case}_repeat{repeat:02d}.mcap"
        for case in ("case14", "random000007")
        for repeat in (0, 1)
    ]
    *_, clean, noisy = map(read_episode, recorded)
    assert clean.task == "reaching"
    assert clean.situation == noisy.situation == REACHING.sample(7)
    assert not np.array_equal(clean.actions, noisy.actions)
    assert "obstacle" not in clean.body_names


@pytest.mark.parametrize(
    "text", ["", "some", "45", "1,99", "-1", "3-", "5-2", "random", "random:0", "random:x"]
)
def test_cases_that_do_not_exist_are_refused(text: str) -> None:
    with pytest.raises(UserError, match="--cases"):
        parse_cases(text, TASK, seed=0)


def test_ctrl_c_stops_cleanly(tmp_path: Path) -> None:
    """As a terminal does it: the interrupt reaches the command and all of its workers."""
    command = f"tutor --cases all --repeats 1 --workers 2 --out {tmp_path}".split()
    process = subprocess.Popen(
        [sys.executable, "-m", "services.cli", *command],
        start_new_session=True,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        eventually(
            lambda: bool(list(tmp_path.glob("*.mcap"))) or process.poll() is not None,
            "a recording",
            patience_s=180.0,  # two workers start, each with all libraries, and play an episode
        )
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 130
    assert "Traceback" not in errors
    recorded = sorted(tmp_path.glob("*.mcap"))
    assert 1 <= len(recorded) < 45
    for path in recorded:
        read_episode(path)
    assert not list(tmp_path.glob("*.part"))
    assert_gone(process.pid)


def assert_gone(group: int) -> None:
    """No process of the group is left, or the last one ends soon."""

    def gone() -> bool:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        return False

    eventually(gone, f"all processes of group {group} have ended")
