"""Starts and stops real processes for tests, with time limits."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

PATIENCE_S = 60.0


@contextmanager
def vmdnn(*words: str | Path, log: Path | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """Run `vmdnn WORDS` in another process, which is killed when the context ends."""
    command = [sys.executable, "-m", "services.cli", *map(str, words)]
    with (log or Path("/dev/null")).open("ab") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=stream)
    try:
        yield process
    finally:
        process.kill()
        process.wait(PATIENCE_S)


@contextmanager
def listening_hub(endpoint: str, *words: str | Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run `vmdnn hub` in another process, and wait until it accepts connections."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")

    def listens() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex((host, int(port))) == 0

    with vmdnn("hub", "--connect", endpoint, *words) as process:
        eventually(listens, f"a hub at {endpoint}")
        yield process


def run_vmdnn(*words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run `vmdnn WORDS` in another process until it ends."""
    return subprocess.run(
        [sys.executable, "-m", "services.cli", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


def stop(process: subprocess.Popen[bytes]) -> int:
    """Stop a process with SIGTERM and return its exit status."""
    process.terminate()
    return process.wait(PATIENCE_S)


def eventually(reached: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> None:
    """Wait until `reached` returns true; fail after `patience_s` seconds."""
    over_s = time.monotonic() + patience_s
    while not reached():
        assert time.monotonic() < over_s, f"never happened: {what}"
        time.sleep(0.05)
