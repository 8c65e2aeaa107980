"""Runs the processes of a run under supervisord, and starts those again that end or are stuck.

supervisord starts and stops processes and keeps their logs. Whether one is started again, and when,
decides `Watchdog`. All processes end when the run ends.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self
from xmlrpc.client import Fault, ServerProxy

from supervisor.xmlrpc import Faults, SupervisorTransport

from deploy.processes import (
    BAD_INPUT,
    FIRST_BEAT_WITHIN_S,
    STOP_SIGNAL,
    STUCK_AFTER_S,
    Program,
)
from proto.errors import UserError
from proto.lifecycle import Lifecycle
from proto.storage import written_whole
from services.arguments.process import HEARTBEAT_FILE

START_WITHIN_S: Final = 20.0
ANSWER_WITHIN_S: Final = 10.0
"""Time in which supervisord must answer a request."""
WELL_AFTER_S: Final = 60.0
"""A process that has run for this time is started again at once when it ends."""
LONGEST_DELAY_S: Final = 30.0
_LATE_S: Final = 30.0
_SOCKET_PATH_BYTES: Final = 100

# The kernel sends SIGTERM to a process when its parent dies for any reason. All processes therefore
# end when the script is killed.
_DIES_WITH_PARENT: Final = ("setpriv", "--pdeathsig", STOP_SIGNAL, "--")


@dataclass(frozen=True)
class ProcessState:
    """The state of one process.

    Attributes:
        name: name of the process, see Program.
        group: name of its program.
        state: the state in supervisord's terms, such as RUNNING, EXITED or FATAL.
        pid: process id, 0 if it does not run.
        started_s: time of its last start (Unix time), 0 if it was not started.
        exit_status: exit status of the last process of this name that ended; -1 after a signal.
        log: file with its output.
        heartbeat_ns: when it touched its heartbeat file last (Unix time); None if that cannot be
            known.
    """

    name: str
    group: str
    state: str
    pid: int
    started_s: int
    exit_status: int
    log: Path
    heartbeat_ns: int | None = None

    @property
    def ended(self) -> bool:
        """Whether it was started and does not run any more."""
        return bool(self.started_s) and self.state in {"EXITED", "FATAL", "STOPPED"}

    @property
    def cannot_work(self) -> bool:
        """Whether it has ended because of bad input, so that another start would not help."""
        return self.ended and self.exit_status == BAD_INPUT


class SupervisorEndedError(Exception):
    """supervisord has ended although it was not told to."""


class Supervisor:
    """Starts programs on request, and stops all in reverse order when its context ends.

    The context must be entered on the main thread, because the kernel ends the processes when the
    thread that started them ends.

    Attributes:
        programs: the programs, in the order of starting.
    """

    def __init__(self, programs: Sequence[Program], folder: Path) -> None:
        """Make a supervisor that writes its configuration and all logs to `folder`.

        Entering its context raises UserError if supervisord cannot be started.
        """
        self.programs = programs
        self._folder = folder.resolve()
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self._socket_folder = _short_folder()
        self._socket = Path(self._socket_folder.name) / "socket"
        self._heartbeats = self._socket.parent
        config = self._folder / "supervisord.conf"
        with written_whole(config) as stream:
            stream.write(supervisord_config(self.programs, self._folder, self._socket).encode())
        self._process = subprocess.Popen(
            (*_DIES_WITH_PARENT, sys.executable, "-m", "supervisor.supervisord", "-c", config),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C must not reach supervisord
        )
        try:
            self._wait_until_it_replies(config)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    def start(self, program: str) -> None:
        """Start the processes of a program."""
        self._ask("startProcessGroup", program, False)

    def start_again(self, process: ProcessState) -> None:
        """Start a process that has ended; nothing happens if it runs."""
        self._ask_for(process, "startProcess", False)

    def kill(self, process: ProcessState) -> None:
        """Send SIGKILL to a process; nothing happens if it has ended."""
        self._ask_for(process, "signalProcess", "KILL")

    def processes(self) -> list[ProcessState]:
        """Return the state of all processes.

        Raises:
            SupervisorEndedError: supervisord has ended.
        """
        return [
            ProcessState(
                name=info["name"],
                group=info["group"],
                state=info["statename"],
                pid=info["pid"],
                started_s=info["start"],
                exit_status=info["exitstatus"],
                log=Path(info["stdout_logfile"]),
                heartbeat_ns=self._heartbeat_ns(info["name"]),
            )
            for info in self._ask("getAllProcessInfo")
        ]

    def stop(self) -> None:
        """Stop all processes and wait until they have ended; further calls do nothing."""
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(timeout=sum(p.stop_within_s for p in self.programs) + 10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._end_orphans()
        self._process = None
        self._socket_folder.cleanup()

    def heartbeat_file(self, process: str) -> Path:
        """The file that a process touches as long as it goes on."""
        return self._heartbeats / process

    def _heartbeat_ns(self, process: str) -> int | None:
        file = self.heartbeat_file(process)
        try:
            if not file.exists():
                file.touch()
            return file.stat().st_mtime_ns
        except OSError:  # such as a full disk
            return None

    def _end_orphans(self) -> None:
        """Wait for processes that supervisord left behind, and kill those that do not end.

        They got SIGTERM when supervisord died.
        """
        deadline = time.monotonic() + max((p.stop_within_s for p in self.programs), default=0)
        while orphans := self._children():
            if time.monotonic() > deadline:
                for pid in orphans:
                    with contextlib.suppress(OSError):
                        os.kill(pid, signal.SIGKILL)
                return
            time.sleep(0.1)

    def _children(self) -> list[int]:
        """Living processes that this supervisor started; the path in their environment tells."""
        mark, found = str(self._heartbeats).encode(), []
        for environment in Path("/proc").glob("[0-9]*/environ"):
            with contextlib.suppress(OSError):  # it has just ended, or is somebody else's
                if mark in environment.read_bytes():
                    found.append(int(environment.parent.name))
        return found

    def _ask(self, method: str, *arguments: object) -> Any:
        # A transport cannot be used again after a failure, so each request makes a new one.
        transport = SupervisorTransport(serverurl=f"unix://{self._socket}")
        default_s = socket.getdefaulttimeout()
        socket.setdefaulttimeout(ANSWER_WITHIN_S)  # the transport has no option for it
        try:
            with ServerProxy("http://supervisord", transport) as supervisord:
                return getattr(supervisord.supervisor, method)(*arguments)
        except Fault as error:
            if error.faultCode != Faults.SHUTDOWN_STATE:
                raise
            raise SupervisorEndedError("supervisord was told to stop its processes") from error
        except (OSError, HTTPException) as error:
            if self._process is None or self._process.poll() is None:
                raise
            raise SupervisorEndedError(
                "supervisord was killed, and its processes were stopped with it"
            ) from error
        finally:
            socket.setdefaulttimeout(default_s)

    def _ask_for(self, process: ProcessState, method: str, *arguments: object) -> None:
        # The state may have changed since it was looked at: then supervisord answers with a fault.
        with contextlib.suppress(Fault):
            self._ask(method, f"{process.group}:{process.name}", *arguments)

    def _wait_until_it_replies(self, config: Path) -> None:
        deadline = time.monotonic() + START_WITHIN_S
        while True:
            try:
                self.processes()
            except (OSError, HTTPException, SupervisorEndedError) as error:
                ended = self._process is None or self._process.poll() is not None
                if ended or time.monotonic() > deadline:
                    raise UserError(
                        f"supervisord does not start; to see why: {sys.executable} -m"
                        f" supervisor.supervisord --nodaemon --configuration {config}"
                    ) from error
                time.sleep(0.1)
            else:
                return


@dataclass
class _Watched:
    """What the watchdog remembers of a process.

    Attributes:
        heartbeat_ns: its last heartbeat.
        beat_at_s: when the watchdog saw it (monotonic clock).
        beats: whether it has had a heartbeat since its start.
        start_at_s: when it will be started again; None if it runs.
        delay_s: how long it waited for its last start.
        up_since_s: when the watchdog saw it run for the first time since its start.
    """

    heartbeat_ns: int | None
    beat_at_s: float
    beats: bool = False
    start_at_s: float | None = None
    delay_s: float = 0.0
    up_since_s: float = 0.0


class Watchdog:
    """Starts processes again that have ended, and kills those that have no heartbeat.

    A process is started again at once, and later each time that it ends soon after its start.
    """

    def __init__(
        self,
        supervisor: Supervisor,
        tell: Callable[[str], None],
        *,
        stuck_after_s: float = STUCK_AFTER_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Watch the processes of a supervisor.

        Args:
            supervisor: its programs.
            tell: called with a sentence about each process that ended or is stuck.
            stuck_after_s: a process without a heartbeat for this time is killed (s).
            clock: gives the time in seconds.
        """
        self._supervisor = supervisor
        self._tell = tell
        self._stuck_after_s = stuck_after_s
        self._clock = clock
        self._watched: dict[str, _Watched] = {}
        self._looked_at_s = self._answered_at_s = clock()

    def look(self) -> None:
        """Look after all processes; called about once a second.

        Raises:
            ProcessFailedError: a process ended because of bad input.
            SupervisorEndedError: supervisord has ended.
        """
        now_s = self._clock()
        # Someone who was frozen cannot know how long the others were silent.
        late_s = now_s - self._looked_at_s
        if late_s > _LATE_S:
            self._answered_at_s += late_s
            for watched in self._watched.values():
                watched.beat_at_s += late_s
        self._looked_at_s = now_s
        try:
            for process in self._supervisor.processes():
                self._look_at(process, now_s)
        except (OSError, HTTPException) as error:  # it may answer again
            if now_s - self._answered_at_s > self._stuck_after_s:
                raise SupervisorEndedError(f"supervisord does not answer ({error})") from error
        else:
            self._answered_at_s = now_s

    def look_unless_stopping(self, lifecycle: Lifecycle) -> None:
        """`look`; but whoever stops this process may have stopped supervisord as well."""
        try:
            self.look()
        except SupervisorEndedError:
            if not lifecycle.stopping:
                raise

    def _look_at(self, process: ProcessState, now_s: float) -> None:
        if process.cannot_work:
            _examine_simulator_again()
            raise ProcessFailedError(process, "cannot work and is not started again")
        if not process.started_s:
            return
        beat = process.heartbeat_ns
        watched = self._watched.setdefault(process.name, _Watched(beat, now_s, up_since_s=now_s))
        limit_s = self._stuck_after_s if watched.beats else FIRST_BEAT_WITHIN_S
        if process.ended:
            self._start_again(process, watched, now_s)
        elif beat != watched.heartbeat_ns or beat is None:
            watched.heartbeat_ns, watched.beat_at_s, watched.beats = beat, now_s, True
        elif now_s - watched.beat_at_s > limit_s:
            self._tell(
                f"{process.name} is stuck: no sign of life for {limit_s:.0f} s. It is killed and "
                f"started again; see {process.log}"
            )
            self._supervisor.kill(process)
            watched.beat_at_s = now_s

    def _start_again(self, process: ProcessState, watched: _Watched, now_s: float) -> None:
        if watched.start_at_s is None:
            well = now_s - watched.up_since_s >= WELL_AFTER_S
            watched.delay_s = 0.0 if well else min(2 * watched.delay_s + 0.5, LONGEST_DELAY_S)
            watched.start_at_s = now_s + watched.delay_s
            when = f"in {watched.delay_s:.0f} s" if watched.delay_s >= 1 else "now"
            how = "was killed" if process.exit_status < 0 else f"ended ({process.exit_status})"
            self._tell(f"{process.name} {how} and is started again {when}; see {process.log}")
        if now_s >= watched.start_at_s:
            watched.start_at_s = None
            watched.beats = False
            watched.beat_at_s = watched.up_since_s = now_s
            self._supervisor.start_again(process)


class ProcessFailedError(Exception):
    """A process can never work; the message has the end of its log."""

    def __init__(self, process: ProcessState, problem: str) -> None:
        lines = process.log.read_text(errors="replace").splitlines() if process.log.exists() else []
        last = "\n".join(f"    {line}" for line in lines[-12:])
        super().__init__(f"{process.name} {problem}; the end of {process.log}:\n{last}")


def supervisord_config(programs: Sequence[Program], folder: Path, socket: Path) -> str:
    """Return the text of supervisord's configuration.

    Args:
        programs: the programs.
        folder: folder of the logs.
        socket: socket that supervisord listens on.

    Raises:
        UserError: a name or value contains characters that the configuration cannot contain.
    """
    head = f"""\
[supervisord]
nodaemon=true
silent=true
logfile={_plain(folder / "supervisord.log")}
pidfile={_plain(socket.with_suffix(".pid"))}
childlogdir={_plain(folder)}

[unix_http_server]
file={_plain(socket)}
chmod=0700

[rpcinterface:supervisor]
supervisor.rpcinterface_factory=supervisor.rpcinterface:make_main_rpcinterface
"""
    sections = [
        _section(rank, program, folder, socket.parent)
        for rank, program in enumerate(programs, start=1)
    ]
    return "\n".join([head, *sections])


def _examine_simulator_again() -> None:
    """Have the next start examine what an earlier start has found good; see deploy/setup.sh."""
    with contextlib.suppress(OSError):
        (Path(sys.prefix) / "simulator-ready").unlink(missing_ok=True)


def _short_folder() -> tempfile.TemporaryDirectory[str]:
    """Make a temporary folder for a socket, whose path has at most 107 bytes."""
    for place in (None, "/tmp", "/var/tmp", "/dev/shm"):
        try:
            folder = tempfile.TemporaryDirectory(prefix="vmdnn-", dir=place)
        except OSError:
            continue
        if len(os.fsencode(folder.name)) <= _SOCKET_PATH_BYTES:
            return folder
        folder.cleanup()
    raise UserError(
        "no folder for temporary files can be used: set TMPDIR to a folder that can be written, "
        f"with a path of at most {_SOCKET_PATH_BYTES - 20} characters"
    )


def _section(rank: int, program: Program, folder: Path, heartbeats: Path) -> str:
    name = "%(program_name)s" if program.processes == 1 else "%(program_name)s-%(process_num)d"
    environment = {
        "OMP_NUM_THREADS": program.threads,
        HEARTBEAT_FILE: f"{_plain(heartbeats)}/{name}",
        "TMPDIR": _plain(heartbeats),  # what a killed process leaves there goes with the supervisor
    }
    return f"""\
[program:{program.name}]
command={_plain(shlex.join((*_DIES_WITH_PARENT, *program.command)))}
process_name={name}
numprocs={program.processes}
numprocs_start=1
priority={rank}
environment={",".join(f'{key}="{value}"' for key, value in environment.items())}
autostart=false
autorestart=false
startsecs=0
stopsignal={STOP_SIGNAL}
stopwaitsecs={program.stop_within_s}
killasgroup=true
redirect_stderr=true
stdout_logfile={_plain(folder)}/{name}.log
stdout_logfile_maxbytes=10MB
stdout_logfile_backups=1
"""


def _plain(value: str | Path) -> str:
    text = str(value)
    # In supervisord's configuration these are comments and placeholders, and cannot be quoted.
    if special := next((mark for mark in (" ;", " #", "%", "\n") if mark in text), None):
        raise UserError(f"{text!r} contains {special!r}, which supervisord cannot read: rename it")
    return text
