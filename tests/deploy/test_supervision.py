"""Crashed processes are started again, ended ones are reported, none outlives its supervisor."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from processes import eventually

from deploy.supervision import ProcessState, Program, Supervisor
from proto.errors import UserError

SLEEP = (sys.executable, "-c", "import time; time.sleep(600)")


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()


def states(supervisor: Supervisor) -> dict[str, ProcessState]:
    return {process.name: process for process in supervisor.processes()}


def test_all_programs_run_under_their_names_and_end_with_the_supervisor(tmp_path: Path) -> None:
    with Supervisor([Program("hub", SLEEP), Program("actor", SLEEP, processes=2)], tmp_path) as s:
        s.start("hub")
        s.start("actor")
        eventually(lambda: all(p.pid for p in s.processes()), "all three processes run")
        found = states(s)
        assert set(found) == {"hub", "actor-1", "actor-2"}
        assert all(is_alive(process.pid) for process in found.values())
    assert not any(is_alive(process.pid) for process in found.values())


def test_a_killed_process_is_started_again(tmp_path: Path) -> None:
    with Supervisor([Program("actor", SLEEP)], tmp_path) as supervisor:
        supervisor.start("actor")
        eventually(lambda: states(supervisor)["actor"].state == "RUNNING", "the first process runs")
        first = states(supervisor)["actor"].pid
        os.kill(first, signal.SIGKILL)
        eventually(
            lambda: states(supervisor)["actor"].pid not in (0, first), "another process runs"
        )


def test_a_process_that_ends_with_bad_input_is_not_started_again(tmp_path: Path) -> None:
    command = (sys.executable, "-c", "import sys; print('no such thing'); sys.exit(2)")
    with Supervisor([Program("learner", command)], tmp_path) as supervisor:
        supervisor.start("learner")
        eventually(lambda: states(supervisor)["learner"].gave_up, "supervisord gives up")
        assert "no such thing" in states(supervisor)["learner"].log.read_text()


def test_each_program_gets_its_own_thread_count(tmp_path: Path) -> None:
    folder = tmp_path / "all mine, 'quoted'"
    show = (sys.executable, "-c", "import os; print(os.environ['OMP_NUM_THREADS'])")
    with Supervisor([Program("learner", show, threads=3)], folder) as supervisor:
        supervisor.start("learner")
        log = states(supervisor)["learner"].log
        eventually(lambda: log.exists() and log.read_text() == "3\n", "the log is written")
        assert log.parent == folder


@pytest.mark.parametrize("name", ["run #1", "100%"])
def test_a_folder_name_that_supervisord_cannot_read_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(UserError, match=name), Supervisor([], tmp_path / name):
        pass


@pytest.mark.parametrize("deadly", [signal.SIGKILL, signal.SIGTERM])
def test_no_process_outlives_a_killed_supervisor(tmp_path: Path, deadly: int) -> None:
    script = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from deploy.supervision import Program, Supervisor\n"
        f"with Supervisor([Program('hub', {SLEEP!r})], Path({str(tmp_path)!r})) as supervisor:\n"
        "    supervisor.start('hub')\n"
        "    while not supervisor.processes()[0].pid: time.sleep(0.05)\n"
        "    print(supervisor.processes()[0].pid, flush=True)\n"
        "    time.sleep(600)\n"
    )
    environment = os.environ | {
        "PYTHONPATH": str(Path(__file__).parents[2]),
        "TMPDIR": str(tmp_path),  # a killed process does not tidy up
    }
    with subprocess.Popen(
        (sys.executable, "-c", script), stdout=subprocess.PIPE, text=True, env=environment
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        assert is_alive(child)
        parent.send_signal(deadly)
    eventually(lambda: not is_alive(child), "the child is gone")
