"""The scripts explain themselves, and say what is missing where they may not install it."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from pathlib import Path

import pytest

DEPLOY = Path(__file__).parents[2] / "deploy"
TOOLS = ("bash", "cat", "dirname", "env")


def call(
    *command: str | Path, path: Path | None = None, cwd: Path | None = None
) -> subprocess.CompletedProcess[str]:
    environment = os.environ | ({"PATH": str(path)} if path else {})
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
def test_without_python_and_without_a_way_to_install_it_says_what_to_run(
    bare: Path, script: str
) -> None:
    answer = call(bare / "deploy" / script, path=bare / "bin")
    assert answer.returncode == 1
    assert "Python 3.11 or 3.12 with venv is needed" in answer.stderr
    assert "apt-get install --no-install-recommends python3 python3-venv" in answer.stderr


def test_a_machine_that_is_set_up_is_left_alone(tmp_path: Path) -> None:
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
