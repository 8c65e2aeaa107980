"""`vmdnn bench actor --json`: its output, not the speed of this machine."""

from __future__ import annotations

import json

import pytest

from actors import bench
from actors.backends.mujoco import graphics
from actors.simulator import installed_backends
from services.cli import main


def test_prints_what_was_measured(monkeypatch, capsys):
    monkeypatch.setattr(bench, "REPETITIONS", 1)
    assert main(["bench", "actor", "--json"]) == 0
    speed = json.loads(capsys.readouterr().out)
    assert list(speed) == [
        "machine", "backend", "physics_ms", "render_ms", "network_ms", "network_numpy_ms",
        "core_ms", "steps_per_s", "ratio", "episode_s", "others",
    ]  # fmt: skip
    assert speed["backend"] == "sapien"
    others = speed.pop("others")
    assert {other["backend"] for other in others} == {*installed_backends()} - {"sapien"}
    for each in (speed, *others):
        assert list(each) == list(speed)
        assert "core" in each["machine"]
        assert all(each[name] > 0 for name in list(each)[2:])


def test_a_simulator_that_cannot_run_is_left_out(monkeypatch, capsys):
    monkeypatch.setattr(bench, "REPETITIONS", 1)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", "/nonexistent")
    graphics.find_driver.cache_clear()
    assert main(["bench", "actor"]) == 0
    printed = capsys.readouterr()
    assert "sapien" in printed.out
    assert "mujoco is left out: MuJoCo cannot render" in printed.err
    assert "mujoco" not in printed.out


def test_needs_a_subject(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["bench"])
    assert "SUBJECT" in capsys.readouterr().err
