"""The smoke run over mutual TLS under supervision: it ends, and a stranger gets nothing in."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from ports import free_endpoint
from processes import eventually, run_vmdnn

from deploy.certificates import make_certificates
from proto.keys import Role

ROOT = Path(__file__).parents[2]
PATIENCE_S = 900.0
ROLES = {Role.HUB, Role.LEARNER, Role.EVALUATOR, Role.RECORDER, Role.ACTOR}


class SecureRun:
    """Where the smoke run is, and who may look at it."""

    def __init__(self, folder: Path) -> None:
        self.certificates = folder / "certificates"
        self.endpoint = free_endpoint().replace("tcp/", "tls/")
        self.folder = folder / "runs"
        self.words = (
            *("--config", "smoke", "--set", f"run.folder={self.folder}"),
            *("--set", f"hub.endpoint={self.endpoint}", "--set", "hub.security=mutual-tls"),
        )

    def make_certificates(self) -> None:
        command = (sys.executable, "-m", "deploy.certificates", "--out", self.certificates)
        subprocess.run(command, cwd=ROOT, check=True, timeout=60, stdout=subprocess.DEVNULL)

    @contextmanager
    def started(self, log: Path) -> Iterator[subprocess.Popen[bytes]]:
        """The run in the background; it is stopped when the context ends."""
        trusted = ("--set", f"hub.certificates={self.certificates}")
        command = (sys.executable, "-m", "deploy.run_local", *self.words, *trusted)
        with log.open("wb") as stream:
            process = subprocess.Popen(
                (*command, "--actors", "1", "--set", "dashboard.port=0"),
                cwd=ROOT, stdin=subprocess.DEVNULL, stdout=stream, stderr=stream,
            )  # fmt: skip
        try:
            yield process
        finally:
            process.terminate()
            process.wait(PATIENCE_S)

    def tell(
        self, *words: str, certificates: Path, endpoint: str = ""
    ) -> subprocess.CompletedProcess[str]:
        """What a command says to someone with a folder of certificates."""
        place = ("--connect", endpoint or self.endpoint)
        shown = ("--set", f"hub.certificates={certificates}")
        return run_vmdnn(*words, "--config", "smoke", *place, *shown)

    def roles(self) -> set[str]:
        """Roles of the processes that a watcher sees at work."""
        seen = self.tell("watch", "--once", "--json", certificates=self.certificates)
        if seen.returncode:
            return set()
        return {each["role"] for each in json.loads(seen.stdout)["processes"]}


@pytest.mark.slow
@pytest.mark.timeout(2 * PATIENCE_S)
def test_a_run_with_certificates_ends_and_a_stranger_gets_nothing_in(tmp_path: Path) -> None:
    secure, log = SecureRun(tmp_path), tmp_path / "run.log"
    secure.make_certificates()
    foreign, nothing = tmp_path / "foreign", tmp_path / "nothing"
    make_certificates(foreign)
    nothing.mkdir(mode=0o700)
    with secure.started(log) as process:
        eventually(lambda: secure.roles() >= ROLES, "all processes are at work", PATIENCE_S)
        stop = ("control", "actor", "stop")
        without_encryption = secure.endpoint.replace("tls/", "tcp/")
        refused = {
            "another authority": secure.tell(*stop, certificates=foreign),
            "no certificate": secure.tell(*stop, certificates=nothing),
            "no encryption": secure.tell(
                *stop, certificates=secure.certificates, endpoint=without_encryption
            ),
        }
        assert {name: told.returncode for name, told in refused.items()} == dict.fromkeys(
            refused, 2
        ), refused
        assert secure.tell("control", "actor", "pause", certificates=secure.certificates).stdout
        assert secure.tell("control", "actor", "resume", certificates=secure.certificates).stdout
        assert process.wait(PATIENCE_S) == 0, log.read_text()
    text = log.read_text()
    assert "policy 4, 10 of 10 trials counted" in text
    assert "started again" not in text, "no process has ended before the run"
    checked = run_vmdnn("check", secure.folder / "smoke", "--json")
    assert checked.returncode == 0, checked.stdout
    assert json.loads(checked.stdout)["findings"] == []
