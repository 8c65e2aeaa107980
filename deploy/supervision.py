"""A run's processes under supervisord: what crashes comes back, and nothing outlives the run."""

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
"""Exit status of a process that was given bad input: starting it again would not help."""

# Each process asks the kernel for a SIGTERM when its parent dies, however that dies: a script that
# is killed outright takes everything with it.
_DIES_WITH_PARENT: Final = ("setpriv", "--pdeathsig", "TERM", "--")


@dataclass(frozen=True)
class Program:
    """Processes that run the same command.

    Attributes:
        name: name of the process; where there are several, `name-1`, `name-2` and so on.
        command: what it runs.
        threads: how many threads each process may compute with; threads that fight for cores cost
            far more than they gain.
        processes: how many of it.
        stop_within_s: time from SIGTERM to SIGKILL.
    """

    name: str
    command: Sequence[str]
    threads: int = 1
    processes: int = 1
    stop_within_s: int = 15


@dataclass(frozen=True)
class ProcessState:
    """How one process is doing.

    Attributes:
        name: see Program.
        state: supervisord's word for it, such as RUNNING, EXITED or FATAL.
        pid: its process id, 0 where it does not run.
        started_s: when it was started last (Unix time), 0 if never.
        exit_status: of the last process of that name that ended.
        log: what it printed.
    """

    name: str
    state: str
    pid: int
    started_s: int
    exit_status: int
    log: Path

    @property
    def gave_up(self) -> bool:
        """Whether it ended and is not started again because that would not help."""
        return self.state == "FATAL" or (self.state == "EXITED" and self.exit_status == BAD_INPUT)


class Supervisor:
    """Starts programs when told to, and stops all in the reverse of their order on leaving.

    It must be entered on the main thread: the kernel ties the processes' lives to that thread.

    Attributes:
        programs: what it starts and stops, in this order.
    """

    def __init__(self, programs: Sequence[Program], folder: Path) -> None:
        """Make a supervisor that keeps its config and the logs of all in `folder`."""
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
        """Start the processes of a program; from now on they come back when they crash."""
        self._ask("startProcessGroup", program, False)

    def processes(self) -> list[ProcessState]:
        """How all processes are doing now."""
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
        """Stop everything and wait until it is gone; called again, it does nothing."""
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
    """The text of supervisord's config: logs in `folder`, orders taken on `socket`.

    Raises:
        UserError: a name or value that supervisord's config cannot hold.
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
    # supervisord takes these for comments and for names to fill in, and nothing can quote them.
    if odd := next((mark for mark in (" ;", " #", "%", "\n") if mark in text), None):
        raise UserError(f"{text!r} holds {odd!r}, which supervisord cannot take: rename it")
    return text
