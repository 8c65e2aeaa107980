"""On a machine that cannot render, the message says what to install."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from actors.backends import light, probing
from actors.backends.sapien import graphics, renderer
from actors.backends.sapien.probe import known_devices
from actors.backends.sapien.simulator import SapienSimulator
from actors.simulator import make_simulator
from proto.config import SimulatorConfig
from proto.errors import UserError
from services.cli import main


@pytest.fixture
def no_driver(monkeypatch):
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nonexistent.json")
    monkeypatch.setenv("VK_DRIVER_FILES", "/nonexistent.json")
    graphics.require_graphics.cache_clear()


def test_the_device_that_renders_is_named():
    diagnosis = SapienSimulator.diagnose()
    assert diagnosis.works
    assert diagnosis.found.removeprefix("SAPIEN renders on ") in [
        name for name, _ in known_devices()
    ]
    assert diagnosis.text() == diagnosis.found


@pytest.mark.usefixtures("no_driver")
def test_without_a_driver_every_remedy_is_named():
    diagnosis = SapienSimulator.diagnose()
    assert not diagnosis.works
    assert "no Vulkan driver was found" in diagnosis.found
    for word in ("Debian 12", "bookworm-backports", "Ubuntu 24.04", "24.3", "libnvidia-gl"):
        assert word in diagnosis.text()


@pytest.mark.usefixtures("no_driver")
@pytest.mark.parametrize(
    ("system", "packages"),
    [
        ("debian-12", ("-t", "bookworm-backports", "mesa-vulkan-drivers", "libvulkan1")),
        ("ubuntu-24.04", ("mesa-vulkan-drivers", "libvulkan1")),
        ("debian-13", ("mesa-vulkan-drivers", "libvulkan1")),
    ],
)
def test_the_packages_of_the_driver_depend_on_the_system(system, packages):
    assert SapienSimulator.diagnose().packages_for(system) == packages


@pytest.mark.usefixtures("no_driver")
def test_the_simulator_refuses_with_the_same_message():
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
    monkeypatch.setattr(probing, "TIMEOUT_S", 2.0)
    diagnosis = graphics.diagnose()
    assert problem in diagnosis.found
    assert "bookworm-backports" in diagnosis.text()


def test_its_driver_renders_in_the_calling_thread(monkeypatch):
    """Mesa otherwise starts a thread for each core in each process."""
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    program = (
        "from actors.simulator import load_backend\n"
        "load_backend('sapien')\n"
        "import os\n"
        "print(os.environ['LP_NUM_THREADS'])\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert result.stdout == "0\n"


def test_without_rendering_no_graphics_driver_is_needed():
    program = (
        "from actors.backends.sapien.simulator import SapienSimulator\n"
        "from proto.config import SimulatorConfig\n"
        "import numpy as np\n"
        "from actors.simulator import Crop, JointTargets, Scene\n"
        "start = JointTargets(np.zeros(2), np.full(7, 20.0), np.full(9, 20.0))\n"
        "simulator = SapienSimulator(SimulatorConfig(render=False))\n"
        "simulator.reset(Scene((), start, 0.15))\n"
        "simulator.step(start)\n"
        "simulator.observe(Crop())\n"
        "print('played')\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "VK_ICD_FILENAMES": "/nonexistent.json"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.stdout == "played\n", result.stderr


def test_the_shader_has_the_shared_light():
    text = (Path(renderer.__file__).parent / "shader" / "common" / "surface.glsl").read_text()
    towards = re.search(r"const vec3 TO_SUN = vec3\((.*)\);", text)
    numbers = dict(re.findall(r"const float (\w+) = (.*);", text))
    assert tuple(map(float, towards[1].split(","))) == light.TO_SUN
    assert {name: float(number) for name, number in numbers.items()} == {
        "SUN": light.SUN, "SKY": light.SKY, "GROUND": light.GROUND, "GAMMA": light.GAMMA,
    }  # fmt: skip
