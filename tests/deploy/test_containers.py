"""A run by Compose, in real containers of the image: smoke run, more actors, stop, continue."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest
from processes import eventually

from deploy.manifests import main

ROOT = Path(__file__).parents[2]
PATIENCE_S = 900.0


def compose_command() -> tuple[str, tuple[str, ...]] | None:
    """The engine, and its Compose; None if there is no engine with an image `vmdnn`."""
    for engine, compose in (
        ("docker", ("docker", "compose")),
        ("podman", ("podman-compose",)),
    ):
        checks = ((engine, "image", "inspect", "vmdnn"), (*compose, "version"))
        if all(map(shutil.which, {engine, compose[0]})) and all(map(succeeds, checks)):
            return engine, compose
    return None


def succeeds(command: tuple[str, ...]) -> bool:
    return subprocess.run(command, check=False, capture_output=True).returncode == 0


COMPOSE = compose_command()
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3 * PATIENCE_S),
    pytest.mark.skipif(
        COMPOSE is None,
        reason="needs Docker or Podman with Compose, and the image: `docker build -f"
        " deploy/container/Dockerfile -t vmdnn .`",
    ),
]


class Project:
    """The containers of a run."""

    def __init__(self, folder: Path) -> None:
        assert COMPOSE is not None
        self._engine, self._compose = COMPOSE
        self._folder = folder
        self._name = f"vmdnn-test-{uuid4().hex[:8]}"

    def compose(self, *words: str) -> None:
        file = str(self._folder / "compose.yaml")
        command = (*self._compose, "-f", file, "-p", self._name, *words)
        subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE_S)

    def states(self) -> list[str]:
        """What the engine says of each container, such as `Exited (0) 3 seconds ago`."""
        label = f"label=com.docker.compose.project={self._name}"
        return self._said("ps", "--all", "--filter", label, "--format", "{{.Status}}").splitlines()

    def log(self, service: str) -> str:
        """The log of the first container of a service."""
        return self._said("logs", self._names(service)[0])

    def inside(self, service: str, script: str) -> str:
        """What a shell script says in the first container of a service."""
        return self._said("exec", self._names(service)[0], "sh", "-c", script)

    def _names(self, service: str) -> list[str]:
        project, of_service = (
            f"label=com.docker.compose.{key}={value}"
            for key, value in (("project", self._name), ("service", service))
        )
        told = self._said(
            *("ps", "--all", "--filter", project, "--filter", of_service, "--format", "{{.Names}}")
        )
        return told.splitlines()

    def _said(self, *words: str) -> str:
        done = subprocess.run(
            (self._engine, *words),
            check=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        return done.stdout


@pytest.fixture
def project(tmp_path: Path) -> Iterator[Project]:
    smoke = ROOT / "deploy/config/smoke.yaml"
    assert main(["compose", "--config", str(smoke), "--actors", "2", "--out", str(tmp_path)]) == 0
    project = Project(tmp_path)
    try:
        yield project
    finally:
        project.compose("down", "--volumes")


def test_a_run_by_compose_reaches_its_end_and_is_continued(project: Project) -> None:
    project.compose("up", "--detach", "--no-build")
    published = "policy 4 is published"
    eventually(lambda: published in project.log("learner"), "the end", PATIENCE_S)
    counted = "grep -c '\"policy_version\": 4' /data/*/evaluation/trials.jsonl || true"
    eventually(lambda: int(project.inside("evaluator", counted)) > 0, "trials", PATIENCE_S)
    found = "find /data -name '*.mcap' | head -1"
    eventually(lambda: project.inside("recorder", found).strip(), "a recording", PATIENCE_S)
    assert "Read-only file system" in project.inside("actor", "touch /new 2>&1 || true")

    project.compose("stop")
    assert [state.partition(")")[0] for state in project.states()] == ["Exited (0"] * 6
    before = project.log("learner")
    project.compose("start")
    joined = "connected to the hub"
    eventually(lambda: joined in project.log("learner")[len(before) :], "learner", PATIENCE_S)
    assert published not in project.log("learner")[len(before) :]  # it is not trained again
