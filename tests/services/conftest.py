"""Episodes that were really played, shared by the tests of what works on them."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.cli import main


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two tutored cases, each executed clean and with noise; only to be read."""
    folder = tmp_path_factory.mktemp("recordings")
    command = f"tutor --cases 3,41 --repeats 2 --workers 1 --out {folder}"
    assert main(command.split()) == 0
    return folder
