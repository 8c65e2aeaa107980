"""Whole runs on machines that are not as one expects: `pytest -m slow`, some minutes each."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pytest
from deadly_simulator import DEADLY_CASE, DEADLY_SEED
from ports import free_endpoint
from processes import eventually

from proto.recordings.episodes import read_episode

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

ROOT = Path(__file__).parents[2]
PATIENCE_S = 900.0


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


HOUR_S = 3600


def set_clock(file: Path, shift_s: int) -> None:
    """Shift the wall clock of all processes that look at a file."""
    with file.open("r+b") as stream:
        stream.write(shift_s.to_bytes(8, sys.byteorder, signed=True))


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no compiler")
def test_clocks_that_jump_by_hours_change_nothing(tmp_path: Path) -> None:
    clock, library, run = tmp_path / "clock", tmp_path / "clock.so", tmp_path / "smoke"
    clock.write_bytes(bytes(8))
    source = ROOT / "tests" / "jumping_clock.c"
    subprocess.run(("cc", "-O2", "-shared", "-fPIC", "-o", library, source, "-ldl"), check=True)
    env = {**os.environ, "LD_PRELOAD": str(library), "JUMPING_CLOCK": str(clock)}
    log = run / "evaluation" / "trials.jsonl"
    process = started(tmp_path, env=env)

    def reached(what: str, has_come: Callable[[], bool]) -> None:
        eventually(lambda: has_come() or process.poll() is not None, what, PATIENCE_S)
        assert process.poll() is None

    try:
        reached("a sequence", lambda: any(run.glob("tutoring/*.mcap")))
        set_clock(clock, 5 * HOUR_S)
        reached("a policy", lambda: any(run.glob("policies/*.safetensors")))
        set_clock(clock, -7 * HOUR_S)
        reached("a counted trial", lambda: log.exists() and log.stat().st_size > 0)
        set_clock(clock, 30 * HOUR_S)
        output = finish(process, tmp_path)
    finally:
        process.kill()
    assert "is started again" not in output
    assert "is stuck" not in output
    for part in run.glob("logs/*.log"):
        assert "Traceback" not in part.read_text(), part
    lines = (run / "logs" / "learner.log").read_text().splitlines()
    days = {line[:10] for line in lines if line[:2] == "20"}
    assert len(days) > 1, "the clock has jumped"


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
def test_a_user_without_name_home_terminal_and_temporary_folder(open_folder: Path) -> None:
    """As in a container with an arbitrary user id; TMPDIR is long and cannot be written."""
    temporary = open_folder.parent / ("t" * 110)
    temporary.mkdir(mode=0o555)
    env = {"PATH": os.environ["PATH"], "LANG": "C", "TMPDIR": str(temporary)}
    # It may read everything: Python may be installed in a folder that only root may enter.
    read = [f"--{kind}-caps=+dac_read_search" for kind in ("inh", "ambient")]
    user = ("setpriv", "--reuid", "12345", "--regid", "12345", "--clear-groups", *read, "--")
    process = started(open_folder, env=env, prefix=user)
    finish(process, open_folder)
    assert (open_folder / "smoke" / "config.yaml").stat().st_uid == 12345
