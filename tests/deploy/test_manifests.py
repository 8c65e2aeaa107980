"""The files of all engines agree with the one description of the processes."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from ports import free_endpoint
from processes import eventually, stop, vmdnn

from deploy.engines.kubernetes import FRESH, HEARTBEAT
from deploy.manifests import main
from deploy.processes import Program, programs
from proto.config import load_config

DEPLOY = Path(__file__).parents[2] / "deploy"
BASE = DEPLOY / "kubernetes" / "base"
CONFIG = DEPLOY / "config" / "experiment1.yaml"
SERVICES = ("hub", "learner", "evaluator", "recorder")


def written(engine: str, out: Path, *more: str) -> dict[str, str]:
    assert main([engine, "--config", str(CONFIG), "--out", str(out), *more]) == 0
    return {path.name: path.read_text() for path in out.iterdir()}


def described(actors: int = 4) -> dict[str, Program]:
    started = programs(load_config(CONFIG), CONFIG, {"sapien": actors})
    return {program.name: program for program in started}


@pytest.mark.parametrize(
    ("engine", "folder"), [("slurm", "slurm"), ("kubernetes", "kubernetes/base"), ("compose", ".")]
)
def test_what_is_checked_in_is_what_is_written(
    engine: str, folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in written(engine, Path("deploy", folder)).items():
        assert (DEPLOY / folder / name).read_text() == text, f"write {name} again"


@pytest.mark.parametrize("engine", ["systemd", "slurm", "kubernetes", "compose"])
def test_every_engine_stops_and_limits_the_processes_as_described(
    engine: str, tmp_path: Path
) -> None:
    files = written(engine, tmp_path, "--actors", "3")
    if engine == "compose":
        composed = yaml.safe_load(files["compose.yaml"])["services"]
    for name, program in described(3).items():
        memory, stop_s = program.memory_mib, program.stop_within_s
        match engine:
            case "systemd":
                template = "@" if name == "actor" else ""
                unit = files[f"vmdnn-experiment1-{name}{template}.service"]
                assert f"vmdnn {name} " in unit
                assert f"MemoryMax={memory}M\n" in unit
                assert f"TimeoutStopSec={stop_s}\n" in unit
                assert "KillSignal=SIGTERM\nTimeoutStartSec=300\nWatchdogSec=60\n" in unit
                assert "RestartPreventExitStatus=2\n" in unit
            case "slurm" if name == "actor":
                assert f"#SBATCH --mem={memory}M\n" in files["actor.sbatch"]
                assert f"#SBATCH --signal=B:USR1@{stop_s + 45}\n" in files["actor.sbatch"]
                assert "#SBATCH --array=1-3\n" in files["actor.sbatch"]
            case "slurm":
                assert "-m deploy.run_local" in files["services.sbatch"]
            case "kubernetes":
                workload, *_ = yaml.safe_load_all(files[f"{name}.yaml"])
                pod = workload["spec"]["template"]["spec"]
                limits = pod["containers"][0]["resources"]["limits"]
                assert limits["memory"] == f"{memory}Mi"
                drain_s = 60 if name == "actor" else 0
                assert pod["terminationGracePeriodSeconds"] == stop_s + drain_s
                assert workload["spec"]["replicas"] == program.processes
                assert bool(program.volume_gib) == ("volumeClaimTemplates" in workload["spec"])
            case "compose":
                assert composed[name]["stop_grace_period"] == f"{stop_s}s"
                assert composed[name]["mem_limit"] == f"{memory}m"
                assert composed[name].get("deploy", {}).get("replicas", 1) == program.processes
    if engine == "systemd":
        wanted = files["vmdnn-experiment1.target"]
        assert all(f"vmdnn-experiment1-{name}.service" in wanted for name in SERVICES)
        assert wanted.count("-actor@") == 3


def test_names_that_systemd_would_change_are_quoted(tmp_path: Path) -> None:
    out = tmp_path / 'my "100%" $run'
    unit = written("systemd", out)["vmdnn-experiment1-hub.service"]
    (start,) = [line for line in unit.splitlines() if line.startswith("ExecStart=")]
    assert r'my \"100%%\" $$run/config.yaml"' in start


def test_systemd_takes_the_units(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    python = tmp_path / "bin" / "python"
    python.parent.mkdir()
    for name in ("python", "vmdnn"):
        (python.parent / name).symlink_to("/bin/true")
    files = written("systemd", tmp_path / "units", "--python", str(python))
    units = [str(tmp_path / "units" / name) for name in files if name.startswith("vmdnn-")]
    ran = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *units],
        capture_output=True,
        text=True,
        check=False,
    )
    ours = [line for line in ran.stderr.splitlines() if "vmdnn" in line]
    assert ours == []


@pytest.mark.parametrize("script", sorted((DEPLOY / "slurm").glob("*.s*")), ids=lambda p: p.name)
def test_the_scripts_are_bash(script: Path) -> None:
    subprocess.run(["bash", "-n", script], check=True)


def documents(folder: Path) -> list[dict[str, Any]]:
    """What `kubectl apply -k` would send to a cluster."""
    if shutil.which("kubectl") is None:
        pytest.skip("kubectl is not installed")
    ran = subprocess.run(
        ["kubectl", "kustomize", folder], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    return list(yaml.safe_load_all(ran.stdout))


OVERLAYS = [
    BASE,
    *sorted(p.parent for p in DEPLOY.glob("kubernetes/overlays/*/kustomization.yaml")),
]


@pytest.mark.parametrize("folder", OVERLAYS, ids=lambda folder: folder.name)
def test_kubernetes_takes_the_files(folder: Path) -> None:
    reason = "kubernetes-validate is not installed (deploy/setup.sh installs the locked packages)"
    validate = pytest.importorskip("kubernetes_validate", reason=reason).validate
    kinds = []
    for document in documents(folder):
        validate(document, "1.32", strict=True)
        kinds.append(document["kind"])
    assert kinds.count("StatefulSet") == 4
    assert kinds.count("Deployment") == 1
    assert kinds.count("NetworkPolicy") == 2


@pytest.mark.parametrize("folder", OVERLAYS, ids=lambda folder: folder.name)
def test_no_pod_has_more_rights_than_it_needs(folder: Path) -> None:
    sets = [each for each in documents(folder) if each["kind"] in {"StatefulSet", "Deployment"}]
    (config,) = [each for each in documents(folder) if each["kind"] == "ConfigMap"]
    assert len(sets) == 5
    for each in sets:
        pod = each["spec"]["template"]["spec"]
        (container,) = pod["containers"]
        assert pod["securityContext"]["runAsNonRoot"]
        assert ("fsGroup" in pod["securityContext"]) == (folder.name != "openshift")
        assert not pod["automountServiceAccountToken"]
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert container["livenessProbe"]["exec"] == container["startupProbe"]["exec"]
        assert {*container["resources"]["requests"]} == {"cpu", "memory"}
        mounted = {volume["name"]: volume for volume in pod["volumes"]}
        assert mounted["config"]["configMap"]["name"] == config["metadata"]["name"]
        hub = next(value["value"] for value in container["env"] if value["name"] == "HUB")
        assert hub.startswith("tls/" if folder.name == "mutual-tls" else "tcp/")


def test_a_probe_looks_at_the_age_of_the_heartbeat(tmp_path: Path) -> None:
    heartbeat = tmp_path / "heartbeat"
    probe = ["sh", "-c", FRESH.replace(HEARTBEAT, str(heartbeat))]

    def is_alive() -> bool:
        return subprocess.run(probe, stderr=subprocess.DEVNULL, check=False).returncode == 0

    assert not is_alive(), "there is no process yet"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VMDNN_HEARTBEAT_FILE", str(heartbeat))
        with vmdnn("hub", "--connect", free_endpoint()) as hub:
            eventually(is_alive, "a heartbeat")
            os.utime(heartbeat, (0, 0))
            eventually(is_alive, "the next heartbeat")
            assert stop(hub) == 0
    os.utime(heartbeat, (0, 0))
    assert not is_alive()


def test_systemd_hears_that_a_process_is_ready_and_alive(tmp_path: Path) -> None:
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd,
        pytest.MonkeyPatch.context() as m,
    ):
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(60)
        m.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        with vmdnn("hub", "--connect", free_endpoint()) as hub:
            assert [systemd.recv(100) for _ in range(2)] == [b"READY=1\nWATCHDOG=1"] * 2
            assert stop(hub) == 0


def test_bad_input_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["slurm", "--config", str(CONFIG), "--out", str(tmp_path / "out")]
    assert main([*words, "--actors", "other=2"]) == 2
    assert "no actor has the simulator sapien" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
