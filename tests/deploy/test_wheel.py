"""The wheel works in a new environment, from any folder, without the repository."""

from __future__ import annotations

import json
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable
from pathlib import Path

import pytest
from ports import free_endpoint

ROOT = Path(__file__).parents[2]
Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def vmdnn(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Run the command of a wheel that was installed into a fresh environment.

    Its dependencies are those of this environment, which the lock has put there.
    """
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    tracked = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    for name in filter(None, tracked.stdout.split("\0")):
        if not name.startswith(("tests/", "docs/images/")):
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    pip = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")
    build = ("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, source)
    subprocess.run([*pip, *build], check=True)
    (wheel,) = folder.glob("vmdnn-*.whl")
    venv.create(folder / "env", with_pip=False)
    python = folder / "env" / "bin" / "python"
    install = ("--python", python, "install", "--no-deps", "--no-index", wheel)
    subprocess.run([*pip, *install], check=True)
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(folder / "env")}))
    # one line for each folder, and no line for the editable install of the repository
    dependencies = [entry for entry in sys.path if "site-packages" in entry]
    (packages / "dependencies.pth").write_text("\n".join(dependencies))
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [folder / "env" / "bin" / "vmdnn", *words],
            cwd=elsewhere,
            env={"HOME": str(folder), "PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )

    return run


def test_it_has_its_version(vmdnn: Run) -> None:
    assert vmdnn("--version").stdout.startswith("vmdnn 0.")


def test_a_trained_policy_plays(vmdnn: Run) -> None:
    words = "evaluate --config experiment1 --policy pretrained:experiment1 --trials 1 --json"
    ended = vmdnn(*words.split())
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout)["trials"] == 1


def test_doctor_does_not_ask_for_a_checkout(vmdnn: Run) -> None:
    ended = vmdnn("doctor", "--json", "--set", f"hub.endpoint={free_endpoint()}")
    found = {each["check"]: each for each in json.loads(ended.stdout)}
    assert found["packages"]["ok"], found["packages"]


def test_a_built_in_configuration_is_found(vmdnn: Run) -> None:
    ended = vmdnn("watch", "--once", "--config", "smoke", "--connect", free_endpoint())
    assert ended.returncode == 2
    assert "start one with `vmdnn hub`" in ended.stderr


def test_an_unknown_configuration_is_named(vmdnn: Run) -> None:
    ended = vmdnn("inspect", "network", "--config", "smok")
    assert ended.returncode == 2
    names = sorted(path.stem for path in (ROOT / "deploy" / "config").glob("*.yaml"))
    assert f"config file smok does not exist; built in are: {', '.join(names)}" in ended.stderr
