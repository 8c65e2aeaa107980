"""The smoke run on a real Slurm of one node, which the test sets up and ends again."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from ports import free_endpoint
from processes import eventually

from deploy.manifests import main

pytestmark = [pytest.mark.slurm, pytest.mark.timeout(1500)]

ROOT = Path(__file__).parents[2]
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "scancel", "scontrol", "squeue")


def free_port() -> int:
    return int(free_endpoint().rpartition(":")[2])


class Slurm:
    """munged, slurmctld and slurmd on this machine, with all their files in one folder."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._folder = folder
        self.host = socket.gethostname().partition(".")[0]
        self.environment = {
            **os.environ,
            "SLURM_CONF": str(folder / "slurm.conf"),
            "PYTHONPATH": str(ROOT),
            "PATH": f"{os.environ['PATH']}:/usr/sbin",
        }
        for name in ("state", "spool"):
            (folder / name).mkdir()
        key = folder / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        (folder / "slurm.conf").write_text(self._config())
        munge = [
            f"--{name}-file={folder / f'munge.{name}'}" for name in ("key", "pid", "log", "seed")
        ]
        self._run(
            stack, "munged", "--foreground", "--force", f"--socket={folder}/munge.socket", *munge
        )
        eventually((folder / "munge.socket").exists, "munged runs")
        self._run(stack, "slurmctld", "-D", "-c")
        self._run(stack, "slurmd", "-D", "-N", self.host)
        eventually(
            lambda: "State=IDLE" in self.tell("scontrol", "show", "node"), "the node is idle"
        )

    def _config(self) -> str:
        return f"""\
ClusterName=test
SlurmctldHost={self.host}(127.0.0.1)
SlurmctldPort={free_port()}
SlurmdPort={free_port()}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={self._folder}/munge.socket,cred_expire=10
StateSaveLocation={self._folder}/state
SlurmdSpoolDir={self._folder}/spool
SlurmctldLogFile={self._folder}/slurmctld.log
SlurmdLogFile={self._folder}/slurmd.log
SlurmctldPidFile={self._folder}/slurmctld.pid
SlurmdPidFile={self._folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
ReturnToService=2
SchedulerParameters=sched_interval=5
NodeName={self.host} NodeAddr=127.0.0.1 CPUs=16 RealMemory=65536
PartitionName=all Nodes=ALL Default=YES
"""

    def _run(self, stack: ExitStack, *command: str) -> None:
        with (self._folder / f"{command[0]}.out").open("wb") as out:
            process = subprocess.Popen(command, env=self.environment, stdout=out, stderr=out)
        stack.callback(process.wait, 60)
        stack.callback(process.terminate)

    def tell(self, *command: str, cwd: Path | None = None) -> str:
        """Run a command of Slurm's, and return what it printed."""
        ran = subprocess.run(
            command, env=self.environment, cwd=cwd, capture_output=True, text=True, check=False
        )
        return ran.stdout + ran.stderr

    def state(self, job: str) -> str:
        return self._field(job, "JobState")

    def restarts(self, job: str) -> int:
        return int(self._field(job, "Restarts") or 0)

    def queued(self) -> list[str]:
        return self.tell("squeue", "--noheader", "--format=%i %T").splitlines()

    def _field(self, job: str, name: str) -> str:
        found = re.search(rf"\b{name}=(\S+)", self.tell("scontrol", "show", "job", job))
        return found[1] if found else ""


@pytest.fixture
def slurm(tmp_path: Path) -> Iterator[Slurm]:
    path = f"{os.environ['PATH']}:/usr/sbin"
    if missing := [name for name in PROGRAMS if shutil.which(name, path=path) is None]:
        pytest.skip(f"Slurm is not installed: {', '.join(missing)}")
    if os.geteuid() != 0:
        pytest.skip("slurmd needs to be root")
    folder = tmp_path / "slurm"
    folder.mkdir()
    with ExitStack() as stack:
        slurm = Slurm(stack, folder)
        stack.callback(slurm.tell, "scancel", "--user=root")
        yield slurm


class SmokeJobs:
    """The smoke run as jobs of Slurm, with one actor."""

    def __init__(self, slurm: Slurm, folder: Path, *options: str) -> None:
        self.folder = folder
        self.run = folder / "runs" / "smoke"
        smoke = (ROOT / "deploy" / "config" / "smoke.yaml").read_text()
        config = folder / "smoke.yaml"
        config.write_text(
            smoke.replace("  name: smoke", f"  name: smoke\n  folder: {folder}/runs")
            + f"\nhub:\n  endpoint: {free_endpoint()}\n"
        )
        words = ("slurm", "--config", str(config), "--out", str(folder / "jobs"))
        assert main([*words, "--actors", "1", "--python", sys.executable]) == 0
        said = slurm.tell(str(folder / "jobs" / "submit.sh"), *options, cwd=folder)
        found = re.findall(r"job (\d+)", said)
        assert len(found) == 2, said
        self.services, self.actors = found

    def log(self) -> str:
        return "\n".join(file.read_text() for file in sorted(self.folder.glob("*.log")))

    def processes(self) -> list[str]:
        """The processes that name the run's folder."""
        found = []
        for process in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                command = process.read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:  # it has just ended
                continue
            if str(self.run) in command or str(self.folder / "jobs") in command:
                found.append(command)
        return found


def test_a_run_whose_time_is_over_is_queued_again_and_ends(slurm: Slurm, tmp_path: Path) -> None:
    jobs = SmokeJobs(slurm, tmp_path, "--time=60")
    eventually(lambda: any(jobs.run.glob("tutoring/*.mcap")), "a sequence is kept", 300)
    # The warning comes two minutes before the end: now.
    slurm.tell("scontrol", "update", f"JobId={jobs.services}", "EndTime=now+2minutes")
    eventually(lambda: slurm.restarts(jobs.services) == 1, "it is queued again", 240)
    assert "stopping" in jobs.log()
    assert not any((jobs.run / "tutoring").glob("*.part")), "no file is left half"
    for job in (jobs.services, jobs.actors):
        slurm.tell("scontrol", "update", f"JobId={job}", "TimeLimit=60")

    eventually(lambda: slurm.state(jobs.services) == "COMPLETED", "the run is done", 900)
    assert "continuing run smoke" in jobs.log()
    assert "policy 4, 10 of 10 trials counted" in jobs.log()
    lines = (jobs.run / "evaluation" / "trials.jsonl").read_text().splitlines()
    trials = [json.loads(line) for line in lines]
    assert len({(trial["policy_version"], trial["seed"]) for trial in trials}) == len(trials)
    recorded = {path.stem.rpartition("_")[2] for path in jobs.run.glob("rollouts/*")}
    # The actor, in a job of its own, goes on until the hub is gone.
    waiting = {path.stem.rpartition("-")[2] for path in jobs.run.glob("outbox/*/rollouts/*")}
    assert {trial["episode"] for trial in trials} <= recorded | waiting
    eventually(lambda: slurm.queued() == [], "the actors' job ends with the run", 120)
    assert jobs.processes() == []


def test_a_cancelled_run_leaves_nothing_behind(slurm: Slurm, tmp_path: Path) -> None:
    jobs = SmokeJobs(slurm, tmp_path)
    eventually(lambda: any(jobs.run.glob("tutoring/*.mcap")), "a sequence is kept", 300)
    assert len(jobs.processes()) >= 6
    slurm.tell("scancel", jobs.services)
    eventually(lambda: slurm.queued() == [], "no job is left", 120)
    eventually(lambda: jobs.processes() == [], "no process is left", 60)
    assert slurm.state(jobs.services) == "CANCELLED"
    assert "stopping" in jobs.log(), "all processes were stopped, not killed"
