"""The processes of a run under supervisord: crashed ones come back, none outlives the run."""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self
from xmlrpc.client import ServerProxy

from supervisor.xmlrpc import SupervisorTransport

from proto.errors import UserError
from proto.storage import written_whole

START_WITHIN_S: Final = 20.0
BAD_INPUT: Final = 2
"""Exit status for bad input: the process is not started again."""

# The kernel sends SIGTERM to a process whose parent dies, whatever the reason: when the script is
# killed, all its processes end.
_DIES_WITH_PARENT: Final = ("setpriv", "--pdeathsig", "TERM", "--")


@dataclass(frozen=True)
class Program:
    """Processes that run the same command.

    Attributes:
        name: name of the process; where there are several, `name-1`, `name-2` and so on.
        command: what it runs.
        threads: number of threads that each process may compute with; more threads than cores
            make all of them much slower.
        processes: number of processes.
        stop_within_s: time from SIGTERM to SIGKILL.
    """

    name: str
    command: Sequence[str]
    threads: int = 1
    processes: int = 1
    stop_within_s: int = 15


@dataclass(frozen=True)
class ProcessState:
    """The state of one process.

    Attributes:
        name: name of the process, see Program.
        state: the state in supervisord's terms, such as RUNNING, EXITED or FATAL.
        pid: process id, 0 if it does not run.
        started_s: when it was started last (Unix time), 0 if never.
        exit_status: exit status of the last process of this name that ended.
        log: file with its output.
    """

    name: str
    state: str
    pid: int
    started_s: int
    exit_status: int
    log: Path

    @property
    def gave_up(self) -> bool:
        """Whether it has ended and is not started again."""
        return self.state == "FATAL" or (self.state == "EXITED" and self.exit_status == BAD_INPUT)


class Supervisor:
    """Starts programs on request; when its context ends, it stops all in reverse order.

    The context must be entered on the main thread: the kernel ends the processes when the thread
    that started them ends.

    Attributes:
        programs: the programs, in the order of starting.
    """

    def __init__(self, programs: Sequence[Program], folder: Path) -> None:
        """Make a supervisor; its configuration and all logs are kept in `folder`."""
        self.programs = programs
        self._folder = folder.resolve()
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        # A socket's path may have 107 characters at most, so it cannot lie in the run's folder.
        self._socket_folder = tempfile.TemporaryDirectory(prefix="vmdnn-")
        socket = Path(self._socket_folder.name) / "socket"
        config = self._folder / "supervisord.conf"
        with written_whole(config) as stream:
            stream.write(supervisord_config(self.programs, self._folder, socket).encode())
        self._socket = socket
        self._process = subprocess.Popen(
            (*_DIES_WITH_PARENT, sys.executable, "-m", "supervisor.supervisord", "-c", config),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C reaches only us, and we stop it in order
        )
        try:
            self._wait_until_it_answers(config)
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
        """Start the processes of a program; from now on they are started again when they crash."""
        self._ask("startProcessGroup", program, False)

    def processes(self) -> list[ProcessState]:
        """The state of all processes."""
        return [
            ProcessState(
                name=info["name"],
                state=info["statename"],
                pid=info["pid"],
                started_s=info["start"],
                exit_status=info["exitstatus"],
                log=Path(info["stdout_logfile"]),
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
        self._process = None
        self._socket_folder.cleanup()

    def _ask(self, method: str, *arguments: object) -> Any:
        # A transport that failed once stays broken, so each question gets its own.
        transport = SupervisorTransport(serverurl=f"unix://{self._socket}")
        with ServerProxy("http://supervisord", transport) as supervisord:
            return getattr(supervisord.supervisor, method)(*arguments)

    def _wait_until_it_answers(self, config: Path) -> None:
        deadline = time.monotonic() + START_WITHIN_S
        while True:
            try:
                self.processes()
            except (OSError, HTTPException) as error:
                ended = self._process is None or self._process.poll() is not None
                if ended or time.monotonic() > deadline:
                    raise RuntimeError(
                        f"supervisord does not start; try: supervisord -n -c {config}"
                    ) from error
                time.sleep(0.1)
            else:
                return


def supervisord_config(programs: Sequence[Program], folder: Path, socket: Path) -> str:
    """The text of supervisord's configuration: logs in `folder`, commands through `socket`.

    Raises:
        UserError: a name or value contains what supervisord's configuration cannot express.
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
    sections = [_section(rank, program, folder) for rank, program in enumerate(programs, start=1)]
    return "\n".join([head, *sections])


def _section(rank: int, program: Program, folder: Path) -> str:
    name = "%(program_name)s" if program.processes == 1 else "%(program_name)s-%(process_num)d"
    return f"""\
[program:{program.name}]
command={_plain(shlex.join((*_DIES_WITH_PARENT, *program.command)))}
process_name={name}
numprocs={program.processes}
numprocs_start=1
priority={rank}
environment=OMP_NUM_THREADS="{program.threads}"
autostart=false
autorestart=unexpected
exitcodes=0,{BAD_INPUT}
startsecs=0
stopsignal=TERM
stopwaitsecs={program.stop_within_s}
killasgroup=true
redirect_stderr=true
stdout_logfile={_plain(folder)}/{name}.log
stdout_logfile_maxbytes=10MB
stdout_logfile_backups=1
"""


def _plain(value: str | Path) -> str:
    text = str(value)
    # supervisord reads these as comments and placeholders, and has no way to quote them.
    if odd := next((mark for mark in (" ;", " #", "%", "\n") if mark in text), None):
        raise UserError(f"{text!r} holds {odd!r}, which supervisord cannot read: rename it")
    return text
