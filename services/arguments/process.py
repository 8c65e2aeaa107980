"""Runs a process on the bus from the command line."""

from __future__ import annotations

import argparse
import logging
import os
import socket
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Final, Protocol

from proto.bus import Bus, CannotListenError, join_hub, open_hub
from proto.config import Config
from proto.errors import UserError
from proto.joining import Claim, ask_configuration
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.periodic import every
from proto.run_locks import own_id, single_process
from proto.security import actor_name
from proto.storage import DiskFullError, StorageError
from services.arguments.common import config_of, overrides_of
from services.arguments.logs import ProcessLog

LOG = logging.getLogger(__name__)

HEARTBEAT_FILE: Final = "VMDNN_HEARTBEAT_FILE"
"""Environment variable with the path of a file that a supervised process touches."""
SYSTEMD_SOCKET: Final = "NOTIFY_SOCKET"
"""Environment variable with the socket on which systemd hears of a process that it supervises."""
HEARTBEAT_S: Final = 1.0
STUCK_S: Final = 600.0
"""The heartbeat ends when the main loop of a process has not gone on for this time."""
TRY_AGAIN_S: Final = 5.0
PRIVATE: Final = 0o077
"""File mode creation mask: what the processes of a run write is for its user alone."""


class Process(Protocol):
    """A process on the bus."""

    def run(self) -> None:
        """Run until the lifecycle is stopping."""


MakeProcess = Callable[[Config, Bus, Lifecycle], Process]


def run_process(arguments: argparse.Namespace, role: Role, make: MakeProcess) -> int:
    """Run one process until SIGTERM, SIGINT or a control message stops it.

    It waits for a hub that does not answer, and for a disk that is full. Under a supervisor it also
    waits for other problems that were none when the run was started: a folder that cannot be
    written, a port that is in use.

    Args:
        arguments: the parsed arguments of `add_process`.
        role: role of the process.
        make: makes the process from configuration, bus and lifecycle; usually its class.

    Returns:
        The exit status.

    Raises:
        UserError: the configuration is not valid, or the run already has such a process.
    """
    os.umask(PRIVATE)
    log = ProcessLog(role.value, arguments)
    config = config_of(arguments)
    log.run = config.run.name
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    told = ""
    taken: set[str] = set()
    with heartbeat(lifecycle):
        while not lifecycle.stopping:
            try:
                with (
                    _identity(config, role, arguments.id, taken) as name,
                    _join(config, role, name, lifecycle) as bus,
                ):
                    log.id = name
                    if bus is None:
                        return 0
                    if role is Role.ACTOR and not Claim(bus).holds(lifecycle):
                        if arguments.id is not None:
                            raise UserError(
                                f"the run {config.run.name} has an actor with the id {name}"
                                " already, on another machine or in another folder: choose"
                                " another --id"
                            )
                        LOG.warning("another actor of the run has the id %s; takes another", name)
                        taken.add(name)
                        continue
                    effective = _effective(config, arguments, bus, lifecycle)
                    if effective is not None:
                        make(effective, bus, lifecycle).run()
            except (StorageError, CannotListenError) as error:
                if lifecycle.stopping or not (is_supervised() or isinstance(error, DiskFullError)):
                    raise
                if str(error) != told:
                    LOG.warning("%s. Waiting, and trying again", error)
                told = str(error)
                lifecycle.waits_for(told)
                lifecycle.wait(TRY_AGAIN_S)
            else:
                return 0
    return 0


def is_supervised() -> bool:
    """Whether a supervisor runs this process, and starts it again when it ends."""
    return HEARTBEAT_FILE in os.environ or SYSTEMD_SOCKET in os.environ


def heartbeat(lifecycle: Lifecycle) -> AbstractContextManager[None]:
    """Tell whoever supervises this process that it lives, as long as the main loop goes on."""
    if not is_supervised():
        return nullcontext()
    path = os.environ.get(HEARTBEAT_FILE)
    file = None if path is None else Path(path)
    if file is not None:
        with suppress(OSError):  # the supervisor's folder is gone, or full
            file.touch()

    def beat() -> None:
        if lifecycle.idle_s >= STUCK_S:
            return
        if file is not None and file.exists():
            os.utime(file)
        _tell_systemd("READY=1\nWATCHDOG=1")

    return every(HEARTBEAT_S, beat)


def _tell_systemd(state: str) -> None:
    """Send a state to systemd, if it has started this process."""
    if name := os.environ.get(SYSTEMD_SOCKET):
        address = f"\0{name[1:]}" if name.startswith("@") else name
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
            systemd.sendto(state.encode(), address)


def _effective(
    config: Config, arguments: argparse.Namespace, bus: Bus, lifecycle: Lifecycle
) -> Config | None:
    """The configuration, which comes from the run's learner with --run; None if asked to stop."""
    if getattr(arguments, "run_name", None) is None:
        return config
    return ask_configuration(bus, overrides_of(arguments), lifecycle)


def _identity(
    config: Config, role: Role, wanted: str | None, taken: Collection[str]
) -> AbstractContextManager[str]:
    """Reserve the id of a process. A run has many actors, but one process of every other role."""
    if role is Role.HUB:  # it does not use the run's folder
        return nullcontext(wanted or role.value)
    if role is Role.ACTOR:
        bound_to = actor_name(config.hub)
        if bound_to and wanted and wanted != bound_to and not wanted.startswith(f"{bound_to}-"):
            raise UserError(
                f"--id {wanted}: the certificate of this machine's actors allows only {bound_to}"
                f" and {bound_to}-NUMBER"
            )
        return own_id(config.run_folder, role, wanted, host=bound_to, taken=taken)
    return single_process(config.run_folder, role, wanted)


@contextmanager
def _join(config: Config, role: Role, name: str, lifecycle: Lifecycle) -> Iterator[Bus | None]:
    """Connect, or be the hub; None if the process was asked to stop before there was a hub."""
    if role is Role.HUB:
        bus: Bus | None = open_hub(config.hub, config.run.name, name)
    else:
        bus = join_hub(config.hub, config.run.name, role, name, lifecycle)
    if bus is None:
        yield None
        return
    with bus:
        yield bus
