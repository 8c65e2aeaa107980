"""Runs a process on the bus from the command line."""

from __future__ import annotations

import argparse
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Final, Protocol

from proto.bus import Bus, join_hub, open_hub
from proto.config import Config
from proto.errors import UserError
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.periodic import every
from proto.run_locks import own_id, single_process
from proto.storage import DiskFullError, StorageError
from services.arguments.common import config_of
from services.arguments.logs import ProcessLog

LOG = logging.getLogger(__name__)

HEARTBEAT_FILE: Final = "VMDNN_HEARTBEAT_FILE"
"""Environment variable with the path of an existing file; a supervised process touches it."""
HEARTBEAT_S: Final = 1.0
STUCK_S: Final = 600.0
"""The heartbeat ends when the main loop of a process has not gone on for this time."""
TRY_AGAIN_S: Final = 5.0


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
    log = ProcessLog(role, arguments)
    config = config_of(arguments)
    log.run = config.run.name
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    told = ""
    with _heartbeat(lifecycle):
        while not lifecycle.stopping:
            try:
                with (
                    _identity(config, role, arguments.id) as name,
                    _join(config, role, name, lifecycle) as bus,
                ):
                    log.id = name
                    if bus is not None:
                        make(config, bus, lifecycle).run()
            except (StorageError, PortInUseError) as error:
                if lifecycle.stopping or not (_supervised() or isinstance(error, DiskFullError)):
                    raise
                if str(error) != told:
                    LOG.warning("%s. Waiting, and trying again", error)
                told = str(error)
                lifecycle.waits_for(told)
                lifecycle.wait(TRY_AGAIN_S)
            else:
                return 0
    return 0


class PortInUseError(UserError):
    """The hub cannot listen, now."""


def _supervised() -> bool:
    return HEARTBEAT_FILE in os.environ


def _heartbeat(lifecycle: Lifecycle) -> AbstractContextManager[None]:
    """Touch the supervisor's file as long as the main loop goes on."""
    if not _supervised():
        return nullcontext()
    file = Path(os.environ[HEARTBEAT_FILE])

    def beat() -> None:
        if lifecycle.idle_s < STUCK_S and file.exists():
            os.utime(file)

    return every(HEARTBEAT_S, beat)


def _identity(config: Config, role: Role, wanted: str | None) -> AbstractContextManager[str]:
    """Reserve the id of a process. A run has many actors, but one process of every other role."""
    if role is Role.HUB:  # it does not use the run's folder
        return nullcontext(wanted or role.value)
    if role is Role.ACTOR:
        return own_id(config.run_folder, role, wanted)
    return single_process(config.run_folder, role, wanted)


@contextmanager
def _join(config: Config, role: Role, name: str, lifecycle: Lifecycle) -> Iterator[Bus | None]:
    """Connect, or be the hub; None if the process was asked to stop before there was a hub."""
    if role is Role.HUB:
        try:
            bus: Bus | None = open_hub(config.hub, config.run.name, name)
        except UserError as error:
            raise PortInUseError(str(error)) from error
    else:
        bus = join_hub(config.hub, config.run.name, role, name, lifecycle)
    if bus is None:
        yield None
        return
    with bus:
        yield bus
