"""A machine that cannot render is told what to install, however its driver fails."""

from __future__ import annotations

import sys

import pytest

from actors.backends.sapien import graphics
from actors.simulator import make_simulator
from proto.config import SimulatorConfig
from proto.errors import UserError
from services.cli import main


@pytest.fixture
def no_driver(monkeypatch):
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nonexistent.json")
    monkeypatch.setenv("VK_DRIVER_FILES", "/nonexistent.json")
    graphics.require_graphics.cache_clear()


def test_says_on_what_it_renders():
    report = graphics.diagnose()
    assert report.works
    assert report.device in report.text()
    assert report.device in [name for name, _ in report.known]


@pytest.mark.usefixtures("no_driver")
def test_without_a_driver_every_cure_is_named():
    report = graphics.diagnose()
    assert not report.works
    assert "no Vulkan driver was found" in report.problem
    for word in ("Debian 12", "bookworm-backports", "Ubuntu 24.04", "24.3", "libnvidia-gl"):
        assert word in report.text()


@pytest.mark.usefixtures("no_driver")
def test_the_simulator_refuses_with_the_same_words():
    with pytest.raises(UserError, match="bookworm-backports"):
        make_simulator(SimulatorConfig())


@pytest.mark.usefixtures("no_driver")
def test_a_failure_is_not_remembered(monkeypatch):
    with pytest.raises(UserError):
        graphics.require_graphics()
    monkeypatch.undo()
    graphics.require_graphics()


@pytest.mark.usefixtures("no_driver")
def test_the_command_line_prints_no_stack_trace(capsys):
    assert main(["bench", "actor", "--json"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "mesa-vulkan-drivers" in printed.err
    assert "Traceback" not in printed.err


@pytest.mark.parametrize(
    ("behaviour", "problem"),
    [
        ("kill -SEGV $$", "crashed (signal 11)"),
        ("echo 'libvulkan: broken' >&2; exit 3", "libvulkan: broken"),
        ("sleep 20", "hung"),
    ],
)
def test_a_driver_that_kills_its_process_is_reported(monkeypatch, tmp_path, behaviour, problem):
    doomed = tmp_path / "python"
    doomed.write_text(f"#!/bin/sh\n{behaviour}\n")
    doomed.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(doomed))
    monkeypatch.setattr(graphics, "TIMEOUT_S", 2.0)
    report = graphics.diagnose()
    assert problem in report.problem
    assert "bookworm-backports" in report.text()
