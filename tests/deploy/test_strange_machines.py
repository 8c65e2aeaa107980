"""Whole runs on machines that are not as one expects: `pytest -m slow`, some minutes each."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pytest
from deadly_simulator import DEADLY_CASE, DEADLY_SEED
from ports import free_endpoint
from processes import eventually

from proto.recordings.episodes import read_episode

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

ROOT = Path(__file__).parents[2]
PATIENCE_S = 900.0
FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1")


def started(
    folder: Path,
    *words: str,
    env: Mapping[str, str] | None = None,
    prefix: Sequence[str] = (),
) -> subprocess.Popen[str]:
    """The smoke run in a folder without pictures from the simulator."""
    settings = {
        "run.folder": folder,
        "hub.endpoint": free_endpoint(),
        "simulator.render": "false",
    }
    given = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    command = (sys.executable, "-m", "deploy.run_local", "--config", "smoke", "--actors", "1")
    return subprocess.Popen(
        (*prefix, *command, *given, *words),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
        env={**(os.environ if env is None else env), "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"},
    )


def counted(folder: Path) -> list[dict[str, object]]:
    """The trials of the run's last policy."""
    log = folder / "smoke" / "evaluation" / "trials.jsonl"
    trials = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    return [trial for trial in trials if trial["policy_version"] == 4]


def finish(process: subprocess.Popen[str], folder: Path) -> str:
    """Wait for the end of a run, and check that all trials were counted."""
    try:
        output, _ = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 0, output
    assert "policy 4, 10 of 10 trials counted" in output
    each = Counter(trial["seed"] for trial in counted(folder))
    assert sorted(each.items()) == [(seed, 1) for seed in range(1000, 1010)]
    return output


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that every user may use, with a path of more than 110 characters."""
    place = Path(tempfile.mkdtemp())
    place.chmod(0o755)
    folder = place / ("long" * 30)
    folder.mkdir()
    folder.chmod(0o777)
    yield folder
    shutil.rmtree(place)


def test_an_episode_that_kills_its_actor_does_not_hold_up_the_run(tmp_path: Path) -> None:
    process = started(tmp_path, "--backend", "tests.deadly_simulator:DeadlySimulator")
    output = finish(process, tmp_path)
    assert output.count("actor was killed and is started again") >= 6
    reasons = {trial["seed"]: trial["outcome"]["reason"] for trial in counted(tmp_path)}  # type: ignore[index]
    assert reasons.pop(DEADLY_SEED) == "could_not_be_finished"
    assert "could_not_be_finished" not in reasons.values()
    shown = {read_episode(path).seed for path in (tmp_path / "smoke/tutoring").glob("*.mcap")}
    assert {0, 44_000} < shown
    assert 1000 * DEADLY_CASE not in shown
    log = (tmp_path / "smoke" / "logs" / "learner.log").read_text()
    assert "the tutoring of experiment1 with the seed 22000 is given up" in log
    assert "the actor's process died while it played it" in log


@pytest.mark.skipif(not FAKETIME.exists(), reason="Debian's package faketime is not installed")
def test_clocks_that_jump_by_hours_change_nothing(tmp_path: Path) -> None:
    jump = tmp_path / "jump"
    jump.write_text("+0")
    env = {
        **os.environ,
        "LD_PRELOAD": str(FAKETIME),
        "FAKETIME_TIMESTAMP_FILE": str(jump),
        "FAKETIME_CACHE_DURATION": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",  # a monotonic clock does not jump
    }
    run = tmp_path / "smoke"
    process = started(tmp_path, env=env)
    try:
        eventually(lambda: any(run.glob("tutoring/*.mcap")), "a sequence", PATIENCE_S)
        jump.write_text("+5h")
        eventually(lambda: any(run.glob("policies/*")), "a policy", PATIENCE_S)
        jump.write_text("-7h")
        log = run / "evaluation" / "trials.jsonl"
        eventually(lambda: log.exists() and log.stat().st_size > 0, "a counted trial", PATIENCE_S)
        jump.write_text("+30h")
        output = finish(process, tmp_path)
    finally:
        process.kill()
    assert "is started again" not in output
    assert "is stuck" not in output
    for part in run.glob("logs/*.log"):
        assert "Traceback" not in part.read_text(), part


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
def test_a_user_without_name_home_terminal_and_temporary_folder(open_folder: Path) -> None:
    """As in a container with an arbitrary user id; TMPDIR is long and cannot be written."""
    temporary = open_folder.parent / ("t" * 110)
    temporary.mkdir(mode=0o555)
    env = {"PATH": os.environ["PATH"], "LANG": "C", "TMPDIR": str(temporary)}
    user = ("setpriv", "--reuid", "12345", "--regid", "12345", "--clear-groups", "--")
    process = started(open_folder, env=env, prefix=user)
    finish(process, open_folder)
    assert (open_folder / "smoke" / "config.yaml").stat().st_uid == 12345
