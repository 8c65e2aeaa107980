"""MuJoCo's drivers: which is taken, and what the message says on a machine that has none."""

from __future__ import annotations

import ctypes.util
import os
import subprocess
import sys

import numpy as np
import pytest

from actors import simulator
from actors.backends.mujoco import graphics
from actors.backends.mujoco.simulator import MujocoSimulator
from actors.simulator import make_simulator
from proto.config import SimulatorConfig
from proto.errors import UserError
from services.cli import main

NO_EGL = {"__EGL_VENDOR_LIBRARY_DIRS": "/nonexistent"}
ONLY_EGL = {"MUJOCO_GL": "egl"}

PLAY = """
import sys
import numpy as np
from pathlib import Path
from actors.simulator import Crop, JointTargets, make_simulator, Scene
from actors.tasks.experiment1 import world
from proto.config import SimulatorConfig

simulator = make_simulator(SimulatorConfig(backend="mujoco", render=sys.argv[1] == "render"))
scene = world.scene(world.MIDDLE)
simulator.reset(scene)
simulator.step(scene.start)
print(simulator.observe(Crop()).image.tobytes().hex())
loaded = Path("/proc/self/maps").read_text()
names = ("libEGL", "libGL", "libOpenGL", "libOSMesa", "gallium")
print(*(name for name in names if name in loaded))
"""


def play(render: str, **environment: str) -> tuple[np.ndarray, list[str]]:
    """Observe in a process of its own that closes nothing; its picture and graphics libraries."""
    result = subprocess.run(
        [sys.executable, "-c", PLAY, render],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stderr) == (0, "")
    picture, libraries = result.stdout.splitlines()
    return np.frombuffer(bytes.fromhex(picture), dtype=np.uint8).reshape(48, 64), libraries.split()


@pytest.fixture
def no_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (NO_EGL | ONLY_EGL).items():
        monkeypatch.setenv(name, value)
    graphics.find_driver.cache_clear()


def test_the_device_that_renders_is_named() -> None:
    diagnosis = MujocoSimulator.diagnose()
    assert diagnosis.works
    assert diagnosis.found.startswith("MuJoCo renders on ")
    assert diagnosis.found.endswith(("by egl", "by osmesa"))


@pytest.mark.usefixtures("no_driver")
def test_without_a_driver_every_remedy_is_named() -> None:
    diagnosis = MujocoSimulator.diagnose()
    assert not diagnosis.works
    assert "MuJoCo cannot render: egl: " in diagnosis.found
    assert "(MUJOCO_GL is egl)" in diagnosis.found
    for word in ("libegl1", "libgl1-mesa-dri", "libosmesa6", "NVIDIA", "simulator.render=false"):
        assert word in diagnosis.text()
    assert diagnosis.packages_for("debian-12") == ("libegl1", "libopengl0", "libgl1-mesa-dri")


@pytest.mark.usefixtures("no_driver")
def test_the_simulator_refuses_with_the_same_message(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UserError, match="apt-get install libegl1"):
        make_simulator(SimulatorConfig(backend="mujoco"))
    assert main(["bench", "actor", "--set", "simulator.backend=mujoco"]) == 2
    printed = capsys.readouterr()
    assert "apt-get install libegl1" in printed.err
    assert "Traceback" not in printed.err


def test_a_driver_that_kills_its_process_is_reported(monkeypatch, tmp_path) -> None:
    doomed = tmp_path / "python"
    doomed.write_text("#!/bin/sh\nkill -SEGV $$\n")
    doomed.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(doomed))
    assert "egl: the graphics driver crashed (signal 11)" in graphics.diagnose().found


def test_without_rendering_nothing_graphical_is_loaded() -> None:
    picture, libraries = play("blind", **ONLY_EGL)
    assert not picture.any()
    assert libraries == []


def test_a_process_may_end_without_closing_its_simulator() -> None:
    picture, libraries = play("render")
    assert picture.std() > 10.0
    assert libraries


@pytest.mark.skipif(ctypes.util.find_library("OSMesa") is None, reason="needs libosmesa6")
def test_without_egl_it_draws_the_same_by_osmesa() -> None:
    """Also if the process inherits the setting of one that has rendered with EGL."""
    picture, _ = play("render", PYOPENGL_PLATFORM="osmesa")
    by_osmesa, libraries = play("render", PYOPENGL_PLATFORM="egl", **NO_EGL)
    assert "libOSMesa" in libraries
    assert np.abs(by_osmesa.astype(int) - picture).mean() < 0.1


def test_a_backend_that_is_not_installed_is_explained(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(simulator, "is_installed", lambda name: name != "mujoco")
    assert main(["evaluate", "--policy", "tutor", "--trials", "1", "--backend", "mujoco"]) == 2
    message = capsys.readouterr().err
    assert "pip install 'vmdnn[mujoco]'" in message
    assert "Installed are: sapien" in message
