"""`python -m actors.backends` reports to deploy/setup.sh whether a backend can render."""

from __future__ import annotations

import platform
import re
from pathlib import Path

import pytest

from actors.backends.__main__ import main
from actors.simulator import BACKENDS

DARK_BACKEND = """
from actors.backends.sapien.simulator import SapienSimulator
from actors.simulator import Diagnosis


class Dark(SapienSimulator):
    @staticmethod
    def diagnose():
        packages = {"debian-12": ("-t", "new", "lamp"), "other": ("lamp",)}
        return Diagnosis(False, "there is no light", "install a lamp", packages)


class Hopeless(SapienSimulator):
    @staticmethod
    def diagnose():
        return Diagnosis(False, "there is no light")
"""


@pytest.fixture
def dark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A module with backends that cannot render."""
    (tmp_path / "dark_backend.py").write_text(DARK_BACKEND)
    monkeypatch.syspath_prepend(tmp_path)


def test_a_backend_that_can_render_needs_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "renders on" in printed.err


@pytest.mark.usefixtures("dark")
@pytest.mark.parametrize(
    ("release", "packages"),
    [
        ({"ID": "debian", "VERSION_ID": "12"}, "-t new lamp\n"),
        ({"ID": "ubuntu", "VERSION_ID": "24.04"}, "lamp\n"),
        ({"ID": "arch"}, "lamp\n"),
    ],
)
def test_the_packages_for_this_system_are_printed(
    release: dict[str, str],
    packages: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(platform, "freedesktop_os_release", lambda: release)
    assert main(["--actors", "2", "--backend", "dark_backend:Dark"]) == 1
    assert capsys.readouterr() == (packages, "there is no light.\ninstall a lamp\n")


@pytest.mark.usefixtures("dark")
def test_the_backend_is_chosen_as_run_local_chooses_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "config.yaml"
    config.write_text("simulator: {backend: 'dark_backend:Hopeless'}\n")
    assert main(["--config", str(config)]) == 1
    assert capsys.readouterr() == ("", "there is no light.\n")
    assert main(["--config", str(config), "--set", "simulator.backend=dark_backend:Dark"]) == 1
    assert "lamp" in capsys.readouterr().out
    assert main(["--config", str(config), "--set", "simulator.render=false"]) == 0
    assert "no pictures are needed" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--backend", "nothing"], "there is no 'nothing'"),
        (["--set", "simulator.render=perhaps"], "simulator.render"),
        (["--config", "/nowhere.yaml"], "/nowhere.yaml"),
    ],
)
def test_bad_input_gives_status_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert message in printed.err


def test_a_backend_whose_package_is_missing_gives_status_3(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("actors.backends.__main__.is_installed", lambda name: name != "mujoco")
    assert main(["--backend", "mujoco", "--set", "simulator.render=false"]) == 3
    assert capsys.readouterr() == ("mujoco\n", "the packages of mujoco are not installed\n")


def test_only_backends_name_a_graphics_driver():
    root = Path(__file__).parents[3]
    packages = ("proto", "sim_assets", "learner", "actors", "services", "deploy")
    naming = [
        str(file.relative_to(root))
        for package in packages
        for pattern in ("*.py", "*.sh", "*.yaml")
        for file in (root / package).rglob(pattern)
        if re.search(r"vulkan|\begl\b|\bmesa\b|LP_NUM_THREADS", file.read_text(), re.IGNORECASE)
    ]
    assert naming
    folders = tuple(f"actors/backends/{backend}/" for backend in BACKENDS)
    assert all(name.startswith(folders) for name in naming), naming
