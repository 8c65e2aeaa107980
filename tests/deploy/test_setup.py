"""The scripts explain their arguments, and print what is missing if they cannot install it."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

DEPLOY = Path(__file__).parents[2] / "deploy"
TOOLS = ("bash", "cat", "dirname", "env", "readlink")


def call(
    *command: str | Path, path: Path | None = None, cwd: Path | None = None, **more: str
) -> subprocess.CompletedProcess[str]:
    environment = os.environ | ({"PATH": str(path)} if path else {}) | more
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        env=environment,
        cwd=cwd,
        stdin=subprocess.DEVNULL,
        check=False,
    )


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """A checkout without .venv, and beside it in bin/ a system without Python and apt."""
    (tmp_path / "deploy").mkdir()
    for name in ("setup.sh", "run_local.sh", "test.sh", "requirements.lock"):
        shutil.copy(DEPLOY / name, tmp_path / "deploy" / name)
    (tmp_path / "bin").mkdir()
    for tool in TOOLS:
        (tmp_path / "bin" / tool).symlink_to(shutil.which(tool) or tool)
    return tmp_path


def test_help_explains_every_option_and_sets_up_nothing(bare: Path) -> None:
    answer = call(bare / "deploy" / "run_local.sh", "--help", path=bare / "bin")
    assert answer.returncode == 0
    for option in ("--config", "--actors", "--backend", "--set"):
        assert option in answer.stdout
    assert not (bare / ".venv").exists()


@pytest.mark.parametrize("script", ["run_local.sh", "test.sh"])
def test_without_python_and_permission_to_install_it_prints_what_to_run(
    bare: Path, script: str
) -> None:
    answer = call(bare / "deploy" / script, path=bare / "bin")
    assert answer.returncode == 1
    assert "Python 3.11 or 3.12 with venv is needed" in answer.stderr
    assert "apt-get install --no-install-recommends python3 python3-venv" in answer.stderr


def test_a_machine_that_is_set_up_is_not_changed(tmp_path: Path) -> None:
    stamp = DEPLOY.parent / ".venv" / "installed"
    installed_from = (DEPLOY / "requirements.lock", DEPLOY.parent / "pyproject.toml")
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in installed_from)).hexdigest()
    if not stamp.exists() or stamp.read_text().split()[0] != digest:  # else it would install
        pytest.skip("deploy/setup.sh did not make this environment from this checkout")
    before = stamp.stat().st_mtime_ns
    script = f"set -euo pipefail; source {DEPLOY / 'setup.sh'}; setup; echo ready"
    answer = call("bash", "-c", script, cwd=tmp_path)
    assert (answer.returncode, answer.stdout) == (0, "ready\n"), answer.stderr
    assert answer.stderr == ""
    assert stamp.stat().st_mtime_ns == before


def set_up_graphics(bare: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """`setup_simulator` on a machine without a graphics driver and without apt-get."""
    venv = Path(sys.executable).parents[1]
    script = f'set -euo pipefail; source {DEPLOY / "setup.sh"}; VENV={venv}; setup_simulator "$@"'
    return call(
        *("bash", "-c", script, "setup", *arguments),
        path=bare / "bin",
        cwd=bare,
        PYTHONPATH=str(DEPLOY.parent),
        VK_DRIVER_FILES="/nonexistent.json",
    )


def test_without_a_driver_it_prints_the_problem_and_what_to_install(bare: Path) -> None:
    answer = set_up_graphics(bare, "--actors", "2")
    assert answer.returncode == 1
    assert "no Vulkan driver was found" in answer.stderr
    assert "no graphics driver can render" in answer.stderr
    assert re.search("apt-get install --no-install-recommends .*mesa-vulkan", answer.stderr)


@pytest.mark.parametrize(
    "arguments", [("--set", "simulator.render=false"), ("--backend", "nothing")]
)
def test_no_driver_is_installed_if_it_would_not_help(bare: Path, arguments: list[str]) -> None:
    """Without rendering none is needed; run_local.py reports wrong arguments."""
    answer = set_up_graphics(bare, *arguments)
    assert (answer.returncode, answer.stderr) == (0, "")


HIDE_MUJOCO = """
import importlib.util, os

found = importlib.util.find_spec
def find_spec(name, package=None):
    hidden = name == "mujoco" and not os.path.exists(os.environ["INSTALLED"])
    return None if hidden else found(name, package)
importlib.util.find_spec = find_spec
"""


@pytest.mark.parametrize("backend", ["mujoco", "sapien"])
def test_only_the_chosen_simulators_packages_are_installed(bare: Path, backend: str) -> None:
    """Until pip is called, Python finds no package called mujoco."""
    (bare / "sitecustomize.py").write_text(HIDE_MUJOCO)
    venv = Path(sys.executable).parents[1]
    script = (
        f"set -euo pipefail; source {DEPLOY / 'setup.sh'}; VENV={venv}\n"
        'pip_install() { echo "pip install $*"; printf "" >"$INSTALLED"; }\n'
        'setup_simulator "$@"'
    )
    answer = call(
        *("bash", "-c", script, "setup", "--backend", backend, "--set", "simulator.render=false"),
        cwd=bare,
        PYTHONPATH=os.pathsep.join([str(bare), str(DEPLOY.parent)]),
        INSTALLED=str(bare / "installed"),
    )
    assert answer.returncode == 0, answer.stderr
    locked = re.findall(r"^(\S+) ; extra", (DEPLOY / "requirements.lock").read_text(), re.MULTILINE)
    expected = f"pip install --no-deps {' '.join(locked)}\n" if backend == "mujoco" else ""
    assert answer.stdout == expected


def test_the_message_of_a_backend_without_packages_is_printed(bare: Path) -> None:
    (bare / "own_backend.py").write_text(
        "from actors.backends.sapien.simulator import SapienSimulator\n"
        "from actors.simulator import Diagnosis\n"
        "class Own(SapienSimulator):\n"
        "    @staticmethod\n"
        "    def diagnose():\n"
        "        return Diagnosis(False, 'no light', 'buy a lamp')\n"
    )
    answer = set_up_graphics(bare, "--backend", "own_backend:Own")
    assert answer.returncode == 1
    assert answer.stderr == (
        "no light.\nbuy a lamp\nsetup: the simulator cannot render; see above\n"
    )


COUNTING_PYTHON = """#!/bin/bash
printf x >>"$EXAMINED"
exit "$STATUS"
"""
"""In place of Python, whose package `actors.backends` tries the simulator."""


def test_a_simulator_that_was_found_to_work_is_examined_when_something_has_changed(
    bare: Path,
) -> None:
    python, own = bare / "venv" / "bin" / "python", bare / "own.yaml"
    python.parent.mkdir(parents=True)
    python.write_text(COUNTING_PYTHON)
    python.chmod(0o755)
    own.write_text("simulator: {backend: sapien}\n")
    examined = bare / "examined"
    script = (
        f"set -euo pipefail; source {bare / 'deploy' / 'setup.sh'}; VENV={bare / 'venv'}\n"
        "can_install() { return 1; }\n"
        'setup_simulator_once "$@"'
    )

    def times(*arguments: str, status: int = 0, driver: str = "") -> int:
        """How often it is examined by two calls."""
        examined.write_text("")
        for _ in range(2):
            answer = call(
                *("bash", "-c", script, "setup", *arguments),
                cwd=bare,
                EXAMINED=str(examined),
                STATUS=str(status),
                VK_DRIVER_FILES=driver,
            )
            assert answer.returncode == (1 if status == 1 else 0), answer.stderr
        return len(examined.read_text())

    assert times() == 1
    assert times() == 0
    assert times("--backend", "mujoco") == 1
    assert times("--config", "own.yaml") == 1
    own.write_text("simulator: {backend: mujoco}\n")
    assert times("--config", "own.yaml") == 1
    assert times("--config", "own.yaml", driver="/nonexistent.json") == 1
    (bare / "venv" / "installed").write_text("other packages")
    assert times("--config", "own.yaml") == 1
    assert times("--actors", "3", status=2) == 2, "bad input says nothing about the simulator"
    assert times("--actors", "2", status=1) > 2, "it does not work"
    assert times("--actors", "2") == 1


PIP_OUTPUT = """
Collecting torch==2.13.0 (from -c requirements.lock (line 5))
  Downloading torch-2.13.0-cp311-cp311-linux_x86_64.whl (188.4 MB)
  Downloading filelock-3.20.0-py3-none-any.whl (16 kB)
  Downloading numpy-2.0.0.whl (9.5 MB)
"""


def test_progress_is_told_while_packages_come(bare: Path) -> None:
    """Without a terminal; on one pip shows its own bars."""
    lines = PIP_OUTPUT + "".join(f"Collecting package-{n}\n" for n in range(2, 21))
    (bare / "output").write_text(f"{lines}Installing collected packages: torch\n")
    script = (
        f"set -euo pipefail; source {DEPLOY / 'setup.sh'}; VENV={bare}\n"
        f"run_pip() {{ cat {bare / 'output'}; return $STATUS; }}\n"
        "pip_install torch"
    )
    answer = call("bash", "-c", script, cwd=bare, STATUS="0")
    assert answer.returncode == 0, answer.stderr
    assert answer.stderr.splitlines() == [
        "setup: downloading torch-2.13.0-cp311-cp311-linux_x86_64.whl (188.4 MB)",
        "setup: 10 packages so far",
        "setup: 20 packages so far",
        "setup: unpacking",
    ]
    failed = call("bash", "-c", script, cwd=bare, STATUS="1")
    assert failed.returncode == 1
    assert "pip could not install" in failed.stderr
