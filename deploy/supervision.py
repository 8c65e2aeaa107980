"""Runs the processes of a run under supervisord.

Processes that crash are started again. All processes end when the run ends.
"""

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
"""Exit status for bad input; a process that ends with it is not started again."""

# The kernel sends SIGTERM to a process when its parent dies for any reason. All processes therefore
# end when the script is killed.
_DIES_WITH_PARENT: Final = ("setpriv", "--pdeathsig", "TERM", "--")


@dataclass(frozen=True)
class Program:
    """Processes that run the same command.

    Attributes:
        name: name of the process; several processes are called `name-1`, `name-2` and so on.
        command: the command with its arguments.
        threads: number of threads with which each process computes. More threads than cores slow
            all processes down.
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
        started_s: time of its last start (Unix time), 0 if it was not started.
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
    """Starts programs on request, and stops all in reverse order when its context ends.

    The context must be entered on the main thread, because the kernel ends the processes when the
    thread that started them ends.

    Attributes:
        programs: the programs, in the order of starting.
    """

    def __init__(self, programs: Sequence[Program], folder: Path) -> None:
        """Make a supervisor that writes its configuration and all logs to `folder`."""
        self.programs = programs
        self._folder = folder.resolve()
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        # The path of a socket has at most 107 characters; that of the run's folder can be longer.
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
        """Start the processes of a program; supervisord starts them again when they crash."""
        self._ask("startProcessGroup", program, False)

    def processes(self) -> list[ProcessState]:
        """Return the state of all processes."""
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
        # A transport cannot be used again after a failure, so each request makes a new one.
        transport = SupervisorTransport(serverurl=f"unix://{self._socket}")
        with ServerProxy("http://supervisord", transport) as supervisord:
            return getattr(supervisord.supervisor, method)(*arguments)

    def _wait_until_it_replies(self, config: Path) -> None:
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
    # In supervisord's configuration these are comments and placeholders, and cannot be quoted.
    if special := next((mark for mark in (" ;", " #", "%", "\n") if mark in text), None):
        raise UserError(f"{text!r} contains {special!r}, which supervisord cannot read: rename it")
    return text
