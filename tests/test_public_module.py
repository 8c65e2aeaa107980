"""`import vmdnn` works as in docs/python.md, and detects packages that replaced ours."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

import vmdnn
from services.cli import main

ROOT = Path(__file__).parents[1]


def blocks(document: str) -> list[str]:
    """The Python code blocks of a document."""
    text = (ROOT / "docs" / document).read_text()
    return re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)


BLOCKS = blocks("python.md")


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_each_code_block_of_the_page_runs_alone(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(BLOCKS[number].splitlines()) < 20
    monkeypatch.chdir(tmp_path)
    exec(compile(BLOCKS[number], f"docs/python.md, block {number}", "exec"), {})


@pytest.mark.slow
def test_the_cells_of_the_notebook_run_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    cells = blocks("notebook.md")
    assert len(cells) == 5
    names: dict[str, Any] = {}
    for number, cell in enumerate(cells):
        assert len(cell.splitlines()) < 20
        exec(compile(cell, f"docs/notebook.md, cell {number}", "exec"), names)
    assert len(names["losses"]) == 12
    assert names["tally"].trials == 2
    assert names["tally"].rate("lenient").successes > 0  # of the trained policy


def test_a_users_policy_is_found_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "still.py").write_text(BLOCKS[-1])
    (tmp_path / "poor.py").write_text("class Poor:\n    def begin(self, situation, seed): ...\n")
    monkeypatch.chdir(tmp_path)
    command = "evaluate --trials 1 --workers 1 --json --policy"
    assert main([*command.split(), "still:Still"]) == 0
    assert '"lenient": {"successes": 0' in capsys.readouterr().out
    assert main([*command.split(), "poor:Poor"]) == 2
    assert "it lacks: step" in capsys.readouterr().err


def check_help(function: Callable[..., Any]) -> None:
    """Check that `help` shows types, and explains each argument and what is returned."""
    signature = inspect.signature(function)
    assert signature.return_annotation is not inspect.Signature.empty
    text = inspect.getdoc(function) or ""
    for name, parameter in signature.parameters.items():
        assert parameter.annotation is not inspect.Parameter.empty, name
        assert re.search(rf"^    {name}: ", text, flags=re.MULTILINE), f"{function}: {name}"
    assert signature.return_annotation == "None" or "Returns:" in text, function
    assert "Raises:" in text, function


def test_every_public_name_exists_and_is_documented() -> None:
    for name in vmdnn.__all__:
        thing = getattr(vmdnn, name)
        assert name == "__version__" or thing.__doc__, name
        if inspect.isfunction(thing):
            check_help(thing)
    assert vmdnn.__version__ == version("vmdnn")
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = vmdnn.nothing


def test_the_command_needs_no_torch_to_start() -> None:
    code = "import sys, vmdnn; assert not {'torch', 'sapien', 'numpy'} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_a_package_that_replaced_one_of_ours_is_reported(tmp_path: Path) -> None:
    """proto-plus overwrites `proto/__init__.py` when it is installed after vmdnn."""
    for name in ("proto", "sim_assets", "learner", "actors", "services"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_bytes((ROOT / name / "__init__.py").read_bytes())
    (tmp_path / "vmdnn.py").write_bytes((ROOT / "vmdnn.py").read_bytes())
    (tmp_path / "proto" / "__init__.py").write_text('"""Marshals of Google\'s clients."""\n')
    other = tmp_path / "proto_plus-1.0.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: proto-plus\nVersion: 1.0\n")
    (other / "RECORD").write_text("proto/__init__.py,,\n")
    (other / "top_level.txt").write_text("proto\n")
    ended = subprocess.run(
        [sys.executable, "-c", "import vmdnn"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1
    assert "the package 'proto' is not that of vmdnn; proto-plus has replaced it" in ended.stderr
    assert "environment of its own" in ended.stderr
