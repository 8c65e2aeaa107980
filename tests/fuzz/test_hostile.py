"""No hostile input of at most 1 MiB costs more than 64 MiB or a second."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parent
LARGEST_MIB = 64.0
SLOWEST_S = 1.0
"""Processor time."""
LONGEST_ERROR = 10_000


@pytest.fixture(scope="module")
def costs() -> list[dict[str, Any]]:
    """What each input cost a process of its own."""
    folders = os.pathsep.join(map(str, (FOLDER.parents[1], FOLDER.parent, FOLDER)))
    done = subprocess.run(
        [sys.executable, str(FOLDER / "hostile.py")],
        env={**os.environ, "PYTHONPATH": folders},
        capture_output=True,
        text=True,
        check=True,
    )
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_hostile_inputs_are_refused_at_little_cost(costs: list[dict[str, Any]]) -> None:
    assert len(costs) > 100
    wrong = [
        cost
        for cost in costs
        if "died" in cost
        or not cost["declared"]
        or cost["mib"] > LARGEST_MIB
        or cost["s"] > SLOWEST_S
        or cost["told"] > LONGEST_ERROR
    ]
    assert wrong == []
