"""Runs a process on the bus from the command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

from proto.bus import Bus, open_bus, open_hub
from proto.config import Config
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.run_locks import own_id, single_process
from services.arguments.common import config_of, start_logging


class Process(Protocol):
    """A process on the bus."""

    def run(self) -> None:
        """Run until the lifecycle is stopping."""


MakeProcess = Callable[[Config, Bus, Lifecycle], Process]


def run_process(arguments: argparse.Namespace, role: Role, make: MakeProcess) -> int:
    """Run one process until SIGTERM, SIGINT or a control message stops it.

    Args:
        arguments: the parsed arguments of `add_process`.
        role: role of the process.
        make: makes the process from configuration, bus and lifecycle; usually its class.

    Returns:
        The exit status.

    Raises:
        UserError: the configuration is not valid, the hub does not reply, or the run already has
            such a process.
    """
    start_logging(role)
    config = config_of(arguments)
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    with _identity(config, role, arguments.id) as name, _join(config, role, name) as bus:
        make(config, bus, lifecycle).run()
    return 0


def _identity(config: Config, role: Role, wanted: str | None) -> AbstractContextManager[str]:
    """Reserve the id of a process. A run has many actors, but one process of every other role."""
    if role is Role.HUB:  # it does not use the run's folder
        return nullcontext(wanted or role.value)
    if role is Role.ACTOR:
        return own_id(config.run_folder, role, wanted)
    return single_process(config.run_folder, role, wanted)


def _join(config: Config, role: Role, name: str) -> Bus:
    if role is Role.HUB:
        return open_hub(config.hub, config.run.name, name)
    return open_bus(config.hub, config.run.name, role, name)
