"""The backend of docs/your-own-simulator.md plays episodes and passes the conformance suite."""

from __future__ import annotations

import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from actors.simulator import Simulator, load_backend

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs" / "your-own-simulator.md").read_text()
BACKEND = "my_simulators.still:Still"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the document's backend."""
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    (tmp_path / "my_simulators").mkdir()
    (tmp_path / "my_simulators" / "still.py").write_text(code)
    return tmp_path


def call(cwd: Path, path: Path, command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-P", "-m", *command.split()],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(path)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_its_backend_is_found_in_the_current_folder_and_plays(folder: Path) -> None:
    """Also in worker processes, which find it for themselves."""
    options = f"--trials 2 --workers 2 --json --backend {BACKEND}"
    command = f"services.cli evaluate --policy tutor {options}"
    answer = call(folder, ROOT, command)
    assert answer.returncode == 0, answer.stderr
    assert f'"backend": "{BACKEND}"' in answer.stdout


def test_its_backend_refuses_a_scene_with_a_screen(folder: Path) -> None:
    options = f"--trials 1 --workers 1 --backend {BACKEND}"
    command = f"services.cli evaluate --task experiment2 --policy tutor {options}"
    answer = call(folder, ROOT, command)
    assert answer.returncode == 2, answer.stderr
    assert answer.stderr.strip().endswith(
        "Still shows no screens: choose another simulator.backend or task.name"
    )


def test_the_suite_runs_on_it(folder: Path) -> None:
    (command,) = re.findall(r"^PYTHONPATH=FOLDER .*-m (.*)$", TEXT, re.MULTILINE)
    answer = call(ROOT, folder, f"{command} -p no:cacheprovider")
    lines = answer.stdout.splitlines()
    counted = r"\d+ failed, \d+ passed, (\d+ skipped, )?\d+ deselected"
    assert re.search(counted, lines[-1]), answer.stdout
    failed = "\n".join(line for line in lines if line.startswith("FAILED"))
    assert "pushing_the_obstacle" in failed
    assert "world_frame" not in failed
    assert "same_episode" not in failed


def parameters(cls: type, method: str) -> list[str]:
    names = inspect.signature(getattr(cls, method)).parameters
    return [name for name in names if name != "self"]


def test_it_lists_every_method_of_the_contract_with_its_parameters() -> None:
    rows = re.findall(r"^\| `(\w+)\((.*?)\)`", TEXT, re.MULTILINE)
    listed = {method: [name for name in names.split(", ") if name] for method, names in rows}
    methods = Simulator.__abstractmethods__
    assert listed == {method: parameters(Simulator, method) for method in methods}


def test_its_backend_has_the_parameters_of_the_contract(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(folder)
    still = load_backend(BACKEND)
    for method in Simulator.__abstractmethods__:
        assert parameters(still, method) == parameters(Simulator, method)


def test_the_modules_that_it_names_exist() -> None:
    for path in re.findall(r"\]\(\.\./([^)]*)\)", TEXT):
        assert (ROOT / path).is_file(), path
