"""Tries a graphics driver with a script in another process, because a bad driver can crash it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

TIMEOUT_S: Final = 120.0


class ProbeError(Exception):
    """The script did not come to an answer; the message says why."""


def answer_of(script: Path, *arguments: str) -> dict[str, Any]:
    """Run a script, and return the JSON object that is the last line of its output.

    Raises:
        ProbeError: it hung, crashed or failed.
    """
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(sys.path),
        "PYTHONWARNINGS": "ignore",
    }
    try:
        result = subprocess.run(
            [sys.executable, "-P", str(script), *arguments],
            env=environment,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise ProbeError(f"the graphics driver hung for {TIMEOUT_S:.0f} s") from error
    if result.returncode < 0:
        raise ProbeError(f"the graphics driver crashed (signal {-result.returncode})")
    if result.returncode > 0:
        last = (result.stderr.strip().splitlines() or ["no message"])[-1]
        raise ProbeError(f"the attempt ended with status {result.returncode}: {last}")
    answer: dict[str, Any] = json.loads(result.stdout.splitlines()[-1])
    return answer
