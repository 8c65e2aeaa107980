"""`vmdnn bench actor --json`: its output, not the speed of this machine."""

from __future__ import annotations

import json

import pytest

from actors import bench
from services.cli import main


def test_prints_what_was_measured(monkeypatch, capsys):
    monkeypatch.setattr(bench, "REPETITIONS", 1)
    assert main(["bench", "actor", "--json"]) == 0
    speed = json.loads(capsys.readouterr().out)
    assert list(speed) == [
        "machine", "backend", "physics_ms", "render_ms", "network_ms", "network_numpy_ms",
        "core_ms", "steps_per_s", "ratio", "episode_s",
    ]  # fmt: skip
    assert speed["backend"] == "sapien"
    assert "core" in speed["machine"]
    assert all(speed[name] > 0 for name in list(speed)[2:])


def test_needs_a_subject(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["bench"])
    assert "SUBJECT" in capsys.readouterr().err
