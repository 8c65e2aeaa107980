"""Joining a run from another machine."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from ports import free_endpoint
from processes import PATIENCE_S, eventually, listening_hub

from deploy.join import main


@pytest.mark.slow
def test_it_waits_for_the_hub_and_for_the_learner_and_stops_cleanly(tmp_path: Path) -> None:
    endpoint, log = free_endpoint(), tmp_path / "runs" / "some" / "logs" / "actor.log"

    def says(text: str) -> bool:
        return log.exists() and text in log.read_text()

    words = ("--hub", endpoint, "--run", "some", "--actors", "1")
    joined = subprocess.Popen(
        (sys.executable, "-m", "deploy.join", *words, "--set", f"run.folder={tmp_path / 'runs'}"),
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        eventually(lambda: says(f"no hub answers at {endpoint}"), "it waits for the hub", 120.0)
        with listening_hub(endpoint):
            eventually(
                lambda: says("the configuration of the run some"), "it waits for the learner"
            )
            joined.send_signal(signal.SIGTERM)
            told, _ = joined.communicate(timeout=PATIENCE_S)
    finally:
        joined.kill()
    assert joined.returncode == 0
    assert told.startswith(f"1 actor for the run some at {endpoint}; logs in {log.parent}")
    assert "stopping; the same command joins the run again" in told


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--hub", "tcp/10.0.0.1:7447"], "can be reached from other machines"),
        (["--hub", "tls/10.0.0.1:7447", "--certificates", "/nowhere"], "actor.crt does not exist"),
        (["--hub", "somewhere"], "hub.endpoint"),
        (["--hub", "tcp/127.0.0.1:7447", "--run", "../x"], "run.name"),
    ],
)
def test_bad_input_starts_nothing(
    words: list[str],
    problem: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    assert problem in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
