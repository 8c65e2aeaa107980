"""A run as Kubernetes starts it: the manifests' commands, each in a container without Kubernetes.

Each container has a root that cannot be written, a /dev/shm of 64 MB, an empty /tmp, an own /data,
a user id without a name and no HOME, as the manifests and `deploy/container/Dockerfile` say.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from ports import free_endpoint
from processes import eventually

from deploy.manifests import main

ROOT = Path(__file__).parents[2]
PATIENCE_S = 900.0
USER = 65532
SERVICES = ("hub", "learner", "evaluator", "recorder")

CONTAINER = """
set -eu
space=$1 data=$2 config=$3 python=$4; shift 4
mount -t tmpfs tmpfs "$space"
mkdir "$space/upper" "$space/work" "$space/root"
mount -t overlay overlay -o "lowerdir=/,upperdir=$space/upper,workdir=$space/work" "$space/root"
cd "$space/root"
mkdir -p data etc/vmdnn
for folder in "$python" "$(readlink -f "$python")"; do  # the interpreter may belong to root alone
    while folder=$(dirname "$folder"); [ "$folder" != / ]; do chmod go+rx ".$folder"; done
done
for system in proc sys dev; do mount --rbind "/$system" "$system"; done
mount -t tmpfs -o size=64m tmpfs dev/shm
mount --bind "$data" data
mount --bind "$config" etc/vmdnn
mount -t tmpfs -o mode=1777 tmpfs tmp
mount -o remount,ro "$space/root"
exec chroot --userspec=65532:0 --groups=0 . "$@"
"""


def may_mount() -> bool:
    probe = ("unshare", "--mount", "true")
    return (
        os.geteuid() == 0
        and all(map(shutil.which, ("unshare", "chroot")))
        and subprocess.run(probe, check=False, capture_output=True).returncode == 0
    )


class Pods:
    """The containers of a run, and the folder of each with its data and its log."""

    def __init__(self, stack: ExitStack, folder: Path, endpoint: str) -> None:
        self._stack = stack
        self._folder = folder
        self._endpoint = endpoint
        self.manifests = folder / "manifests"

    def start(self, component: str) -> None:
        """Start a pod as its manifest says; it is stopped when the test ends."""
        command = (*self._container(component), *self._command(component))
        self._stack.enter_context(self._running(command, self.log(component)))

    def log(self, component: str) -> Path:
        return self._folder / f"{component}.log"

    def data(self, component: str) -> Path:
        return self._folder / component / "data"

    def say(self, script: str) -> str:
        """What a shell script says in a container of its own."""
        command = (*self._container("shell"), "sh", "-c", script)
        done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60)
        return done.stdout

    def _command(self, component: str) -> list[str]:
        """What the container of a manifest runs, with its environment variables."""
        documents = yaml.safe_load_all((self.manifests / f"{component}.yaml").read_text())
        [container] = [found for each in documents for found in containers(each)]
        assert container["securityContext"]["readOnlyRootFilesystem"]
        places = {mount["mountPath"] for mount in container["volumeMounts"]}
        assert places <= {"/etc/vmdnn", "/certificates", "/tmp", "/data"}
        variables = {each["name"]: each.get("value", "") for each in container["env"]}
        variables |= {"HUB": self._endpoint, "POD": f"{component}-0"} | image_variables()
        words = [
            re.sub(r"\$\((\w+)\)", lambda found: variables[found[1]], word)
            for word in container["command"]
        ]
        told = (f"{key}={value}" for key, value in variables.items())
        return ["env", "-i", "-C", "/data", *told, *words]

    def _container(self, name: str) -> list[str | Path]:
        """Make the folders of a container; return what runs the words that follow in it."""
        place = self._folder / name
        for part in ("space", "data"):
            (place / part).mkdir(parents=True)
        os.chown(place / "data", USER, 0)
        return [
            *("unshare", "--mount", "--propagation", "private", "sh", "-c", CONTAINER, "container"),
            *(place / "space", place / "data", self.manifests, sys.executable),
        ]

    @contextmanager
    def _running(self, command: Sequence[str | Path], log: Path) -> Iterator[None]:
        with log.open("wb") as stream:
            process = subprocess.Popen(list(map(str, command)), stdout=stream, stderr=stream)
        try:
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(120)


def containers(document: dict[str, Any]) -> list[dict[str, Any]]:
    """The containers of a StatefulSet or a Deployment; none of a Service."""
    template = document.get("spec", {}).get("template")
    return template["spec"]["containers"] if template else []


def image_variables() -> dict[str, str]:
    """Environment variables of the image, with the packages of this checkout."""
    text = (ROOT / "deploy/container/Dockerfile").read_text().replace("\\\n", " ")
    [told] = re.findall(r"^ENV (.*)$", text, re.MULTILINE)
    variables = dict(word.split("=", 1) for word in shlex.split(told))
    return variables | {"PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin"}


pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(2 * PATIENCE_S),
    pytest.mark.skipif(not may_mount(), reason="needs root, unshare and the right to mount"),
]


def test_the_containers_are_as_narrow_as_the_manifests_say(tmp_path: Path) -> None:
    with ExitStack() as stack:
        pods = Pods(stack, tmp_path, free_endpoint())
        pods.manifests.mkdir()
        said = pods.say("id -u; touch /new 2>&1; touch /tmp/new && df -m /dev/shm")
    lines = said.splitlines()
    assert lines[0] == str(USER)
    assert "Read-only file system" in lines[1]
    assert lines[-1].split()[1] == "64"


def test_a_run_needs_no_more_than_the_manifests_give(tmp_path: Path) -> None:
    with ExitStack() as stack:
        pods = Pods(stack, tmp_path, free_endpoint())
        smoke = ROOT / "deploy/config/smoke.yaml"
        out = ("--out", str(pods.manifests), "--actors", "1")
        assert main(["kubernetes", *out, "--config", str(smoke)]) == 0
        for component in (*SERVICES, "actor"):
            pods.start(component)
        learner = pods.log("learner")
        eventually(lambda: "policy 4 is published" in learner.read_text(), "the end", PATIENCE_S)
        [run] = pods.data("evaluator").iterdir()
        trials = run / "evaluation" / "trials.jsonl"
        eventually(lambda: '"policy_version": 4' in trials.read_text(), "trials", PATIENCE_S)
        recordings = pods.data("recorder")
        eventually(lambda: any(recordings.rglob("*.mcap")), "a recording", PATIENCE_S)
    for component in (*SERVICES, "actor"):
        assert "Read-only" not in pods.log(component).read_text()
