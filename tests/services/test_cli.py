"""The command line itself."""

from __future__ import annotations

from importlib.metadata import version

import pytest

from services.cli import main


def test_it_prints_its_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"vmdnn {version('vmdnn')}\n"
