"""`vmdnn doctor` finds the problems of a machine and advises what to do."""

from __future__ import annotations

import json
import socket
from importlib.metadata import version
from pathlib import Path

import pytest

from proto.config import SimulatorConfig
from services.cli import main
from services.machine.doctor import (
    LOCK,
    Finding,
    check_cores,
    check_disk,
    check_graphics,
    check_kernel,
    check_locked_packages,
    check_memory,
    check_port,
    check_python,
    check_required_packages,
    read_lock,
)
from tests.ports import free_endpoint


def test_this_machine_has_no_problem(capsys: pytest.CaptureFixture[str]) -> None:
    status = main(["doctor", "--json", "--set", f"hub.endpoint={free_endpoint()}"])
    findings = {finding["check"]: finding for finding in json.loads(capsys.readouterr().out)}
    assert set(findings) == {
        "python", "packages", "cores", "memory", "disk", "hub port", "security", "kernel",
        "graphics",
    }  # fmt: skip
    assert findings["graphics"]["ok"], findings["graphics"]
    assert status == (0 if all(finding["ok"] for finding in findings.values()) else 1)


def test_a_problem_gives_status_1_and_advice(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        assert main(["doctor", "--set", f"hub.endpoint={endpoint}"]) == 1
    output = capsys.readouterr().out
    assert f"PROBLEM hub port: {endpoint}" in output
    assert "choose another port with --set hub.endpoint=" in output


def test_the_locked_packages_are_installed_exactly() -> None:
    finding = check_locked_packages(LOCK)
    assert finding.ok, finding


def test_other_and_missing_packages_are_named(tmp_path: Path) -> None:
    lock = tmp_path / "requirements.lock"
    lock.write_text(f"# a comment\nnumpy=={version('numpy')}\nrich==0.0.1\nno-such-package==1.0\n")
    finding = check_locked_packages(lock)
    assert not finding.ok
    assert f"rich {version('rich')} instead of 0.0.1" in finding.found
    assert "no-such-package missing instead of 1.0" in finding.found
    assert "numpy" not in finding.found
    assert str(lock) in finding.advice


def test_packages_of_an_extra_may_be_missing_but_not_differ(tmp_path: Path) -> None:
    lock = tmp_path / "requirements.lock"
    lock.write_text('no-such-package==1.0 ; extra == "such"\n')
    assert check_locked_packages(lock).ok
    lock.write_text('rich==0.0.1 ; extra == "such"\n')
    assert f"rich {version('rich')} instead of 0.0.1" in check_locked_packages(lock).found


def test_without_a_lock_it_checks_the_requirements_of_the_distribution(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("services.machine.doctor.LOCK", tmp_path / "requirements.lock")
    main(["doctor", "--json", "--set", "simulator.render=false"])
    findings = {finding["check"]: finding for finding in json.loads(capsys.readouterr().out)}
    assert findings["packages"]["ok"], findings["packages"]
    assert "as vmdnn requires" in findings["packages"]["found"]


def test_missing_and_wrong_requirements_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    metadata = tmp_path / "robots-1.0.dist-info" / "METADATA"
    metadata.parent.mkdir()
    metadata.write_text(
        "Metadata-Version: 2.1\nName: robots\nVersion: 1.0\n"
        "Requires-Dist: numpy>=1\n"
        "Requires-Dist: rich>=1000\n"
        "Requires-Dist: no-such-package\n"
        'Requires-Dist: not-needed; extra == "dev"\n'
        'Requires-Dist: not-for-us; sys_platform == "win32"\n'
    )
    monkeypatch.syspath_prepend(tmp_path)
    finding = check_required_packages("robots")
    assert finding.found == f"rich>=1000 ({version('rich')}), no-such-package (missing)"
    assert finding.advice.endswith("-m pip install 'rich>=1000' 'no-such-package'")


def test_without_lock_and_distribution_it_says_what_to_install() -> None:
    assert "checkout" in check_required_packages("no-such-distribution").advice


def test_the_chosen_backend_is_asked_about_graphics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "blind_backend.py").write_text(
        "from actors.backends.sapien.simulator import SapienSimulator\n"
        "from actors.simulator import Diagnosis\n"
        "class Blind(SapienSimulator):\n"
        "    @staticmethod\n"
        "    def diagnose():\n"
        "        return Diagnosis(False, 'no light', 'buy a lamp')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    own = SimulatorConfig(backend="blind_backend:Blind")
    assert check_graphics(own) == Finding("graphics", "no light", "buy a lamp")
    assert check_graphics(own.model_copy(update={"render": False})).ok
    unknown = check_graphics(SimulatorConfig(backend="sapiens"))
    assert "there is no 'sapiens'" in unknown.found
    assert "--set simulator.backend=" in unknown.advice


def test_too_few_resources_are_a_problem(tmp_path: Path) -> None:
    assert not check_cores(1).ok
    assert check_cores(2).ok
    assert not check_memory(0.4).ok
    assert check_memory(8.0).ok
    assert check_disk(tmp_path / "not" / "yet" / "there").found.endswith(str(tmp_path))
    assert check_python().ok


def test_without_a_compiler_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("learner.kernels.build.library_name", lambda: "never-compiled.so")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    assert "apt-get install g++" in check_kernel().advice


@pytest.mark.parametrize("host", ["192.0.2.1", "no.such.host.invalid"])
def test_an_endpoint_of_another_machine_is_a_problem(host: str) -> None:
    assert "an address of this machine" in check_port(f"tcp/{host}:7447").advice


def test_the_lock_contains_the_requirements_of_the_project() -> None:
    locked = read_lock(LOCK)
    assert locked["torch"] == "2.13.0"
    assert "opencv-python" not in locked, "it overwrites opencv-python-headless"
