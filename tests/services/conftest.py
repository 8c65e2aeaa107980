"""Recorded episodes and a checkpoint for several tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from learner.checkpoint import policy_file
from services.cli import main


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two tutored cases, each executed clean and with noise; only to be read."""
    folder = tmp_path_factory.mktemp("recordings")
    command = f"tutor --cases 3,41 --repeats 2 --workers 1 --out {folder}"
    assert main(command.split()) == 0
    return folder


@pytest.fixture(scope="session")
def checkpoint(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network of the paper's size that has hardly learned anything; only to be read."""
    folder = tmp_path_factory.mktemp("run")
    command = (
        f"train --data {recordings} --out {folder} --set learner.epochs=2"
        " --set learner.warmup_epochs=1 --set learner.pretraining.epochs=0"
    )
    assert main(command.split()) == 0
    return policy_file(folder, 1)
