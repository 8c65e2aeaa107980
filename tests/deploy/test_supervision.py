"""Processes that end or are stuck are started again, and none outlives its supervisor."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
from contextlib import nullcontext
from pathlib import Path

import pytest
from processes import eventually

from deploy.processes import FIRST_BEAT_WITHIN_S, STUCK_AFTER_S, Program
from deploy.supervision import (
    ProcessFailedError,
    ProcessState,
    Supervisor,
    SupervisorEndedError,
    Watchdog,
)
from proto.errors import UserError
from proto.lifecycle import Lifecycle

SLEEP = (sys.executable, "-c", "import time; time.sleep(600)")


def is_alive(pid: int) -> bool:
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


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


def test_a_supervisor_that_cannot_start_says_how_to_see_why(tmp_path: Path) -> None:
    refused = Program("no:name", SLEEP)
    with (
        pytest.raises(UserError, match=r"does not start; to see why: .*supervisord\.conf"),
        Supervisor([refused], tmp_path),
    ):
        pass


class Watch:
    """A watchdog over one program, with a clock that is set by hand."""

    def __init__(self, supervisor: Supervisor) -> None:
        self.told: list[str] = []
        self.now_s = 1000.0
        self._supervisor = supervisor
        self.watchdog = Watchdog(supervisor, self.told.append, clock=lambda: self.now_s)
        supervisor.start(supervisor.programs[0].name)

    @property
    def pid(self) -> int:
        return self._supervisor.processes()[0].pid

    def look(self, seconds: float) -> None:
        """Look once a second for so many seconds of the clock."""
        for _ in range(round(seconds)):
            self.now_s += 1.0
            self.watchdog.look()

    def wait_for_another(self, than: int) -> None:
        def another() -> bool:
            self.now_s += 0.1  # slowly: supervisord needs a moment to see that a process has ended
            self.watchdog.look()
            return self.pid not in (0, than)

        eventually(another, "another process runs")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_process_that_was_killed_is_started_again(tmp_path: Path, number: int) -> None:
    lives = (sys.executable, "-c", "print('up', flush=True); import time; time.sleep(600)")
    log = tmp_path / "actor.log"
    with Supervisor([Program("actor", lives)], tmp_path) as supervisor:
        watch = Watch(supervisor)
        # Before its program runs, a process has supervisord's handler of SIGTERM.
        eventually(lambda: log.exists() and "up" in log.read_text(), "its program runs")
        watch.look(1)
        first = watch.pid
        os.kill(first, number)
        watch.wait_for_another(first)
    assert watch.told == [
        f"actor was killed and is started again now; see {tmp_path / 'actor.log'}"
    ]


def test_a_process_that_always_ends_is_started_again_ever_later(tmp_path: Path) -> None:
    ends = (sys.executable, "-c", "print('started')")
    with Supervisor([Program("evaluator", ends)], tmp_path) as supervisor:
        watch = Watch(supervisor)
        log = tmp_path / "evaluator.log"

        def starts() -> int:
            watch.look(1)
            return log.read_text().count("started") if log.exists() else 0

        eventually(lambda: starts() >= 5, "five starts")
    delays = [re.findall(r"again (?:in (\d+) s|now)", line)[0] for line in watch.told]
    assert delays[:4] == ["", "2", "4", "8"]
    assert "evaluator ended (0)" in watch.told[0]


def test_a_frozen_process_is_killed_and_started_again(tmp_path: Path) -> None:
    with Supervisor([Program("actor", SLEEP)], tmp_path) as supervisor:
        watch = Watch(supervisor)
        watch.look(1)
        frozen = watch.pid
        heartbeat = supervisor.heartbeat_file("actor")
        watch.look(FIRST_BEAT_WITHIN_S - 2)
        os.utime(heartbeat)
        watch.look(1)
        os.kill(frozen, signal.SIGSTOP)
        watch.look(STUCK_AFTER_S)
        os.utime(heartbeat)
        watch.look(STUCK_AFTER_S)
        assert watch.told == [], "it gave a sign of life in between"
        watch.now_s += 1000.0  # whoever was frozen itself does not blame the others
        watch.look(1)
        assert watch.told == []
        watch.look(STUCK_AFTER_S)
        assert "actor is stuck: no sign of life for 60 s" in watch.told[0]
        watch.wait_for_another(frozen)


def test_a_process_with_bad_input_is_not_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And deploy/setup.sh examines the simulator again, which may be what does not work."""
    command = (sys.executable, "-c", "import sys; print('no such thing'); sys.exit(2)")
    stamp = tmp_path / "simulator-ready"
    stamp.touch()
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    with Supervisor([Program("learner", command)], tmp_path) as supervisor:
        watch = Watch(supervisor)
        eventually(lambda: states(supervisor)["learner"].cannot_work, "it has ended")
        with pytest.raises(ProcessFailedError, match="no such thing"):
            watch.look(1)
    assert not stamp.exists()


def test_when_supervisord_is_killed_even_frozen_processes_end(tmp_path: Path) -> None:
    with Supervisor([Program("actor", SLEEP)], tmp_path) as supervisor:
        watch = Watch(supervisor)
        watch.look(1)
        frozen = watch.pid
        os.kill(frozen, signal.SIGSTOP)
        parent = Path(f"/proc/{frozen}/stat").read_text().rpartition(")")[2].split()[1]
        os.kill(int(parent), signal.SIGKILL)

        def has_ended() -> bool:
            try:
                supervisor.processes()
            except SupervisorEndedError:
                return True
            except OSError:
                return False
            return False

        eventually(has_ended, "its end is noticed")
    eventually(lambda: not is_alive(frozen), "the frozen process is gone")


def test_a_long_folder_for_temporary_files_is_no_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / ("t" * 110)
    place.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    with Supervisor([Program("actor", SLEEP)], tmp_path) as supervisor:
        supervisor.start("actor")
        assert states(supervisor)["actor"].state in {"STARTING", "RUNNING"}


def test_what_a_killed_process_leaves_in_its_temporary_folder_is_deleted(tmp_path: Path) -> None:
    leaves = "import os, tempfile; print(tempfile.mkdtemp(), flush=True); os.kill(os.getpid(), 9)"
    log = tmp_path / "actor.log"
    with Supervisor([Program("actor", (sys.executable, "-c", leaves))], tmp_path) as supervisor:
        supervisor.start("actor")
        eventually(lambda: log.exists() and log.read_text().endswith("\n"), "it has left something")
        left = Path(log.read_text().strip())
        assert left.is_dir()
    assert not left.exists()


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


@pytest.mark.parametrize("asked", [True, False])
def test_supervisord_may_be_stopped_with_everything_else(tmp_path: Path, asked: bool) -> None:
    """Slurm and systemd send SIGTERM to all processes at once."""
    with Supervisor([Program("actor", SLEEP)], tmp_path) as supervisor:
        watch = Watch(supervisor)
        actor = watch.pid
        parent = Path(f"/proc/{actor}/stat").read_text().rpartition(")")[2].split()[1]
        lifecycle = Lifecycle()
        if asked:
            lifecycle.stop()
        os.kill(int(parent), signal.SIGTERM)

        def has_ended() -> bool:
            watch.watchdog.look_unless_stopping(lifecycle)
            return asked and not is_alive(actor)

        with nullcontext() if asked else pytest.raises(SupervisorEndedError):
            eventually(has_ended, "its end")
