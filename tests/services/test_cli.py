"""The command line itself."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest

from services.cli import main


def test_it_prints_its_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"vmdnn {version('vmdnn')}\n"


def test_a_folder_does_not_hide_a_built_in_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "smoke").mkdir()
    monkeypatch.chdir(tmp_path)
    assert main(["inspect", "network", "--config", "smoke"]) == 0
    assert "mtrnn" in capsys.readouterr().out.lower()
