"""`vmdnn dashboard`: show a run in the browser while it happens, and its recordings."""

from __future__ import annotations

import argparse
import logging
import os
import socket
from typing import Final

from actors.tasks.registry import make_task
from proto.bus import open_bus
from proto.config import Config
from proto.errors import UserError
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.membership import METRICS_PERIOD_S
from proto.permissions import Holder
from proto.security import certificate_for
from services.arguments.common import add_connection, add_log_options, config_of, integer
from services.arguments.logs import ProcessLog
from services.arguments.process import TRY_AGAIN_S, heartbeat, is_supervised
from services.board import Board
from services.dashboard.access import Access
from services.dashboard.ports import PortTakenError, address_of, listening_socket
from services.dashboard.run_source import RunSource
from services.dashboard.server import make_app, serving
from services.dashboard.videos import Videos

LOG = logging.getLogger(__name__)

PRESENT_WITHIN_S: Final = 2.5 * METRICS_PERIOD_S


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_connection(parser)
    add_log_options(parser)
    parser.add_argument(
        "--port",
        type=integer(0, 2**16 - 1),
        help="port of the page, 0 for any free one; without it, dashboard.port of the"
        " configuration, or the next free one",
    )
    parser.add_argument(
        "--host",
        help="address at which the page can be opened, such as 0.0.0.0 for all of this machine's;"
        " without it, dashboard.host of the configuration",
    )
    parser.add_argument(
        "--allow-control",
        action="store_true",
        help="let the page pause, resume and stop processes; only where no other machine can open"
        " the page",
    )


def run(arguments: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C or SIGTERM."""
    log = ProcessLog("dashboard", arguments)
    config = config_of(arguments)
    log.run, log.id = config.run.name, f"dashboard-{os.getpid()}"
    host = arguments.host or config.dashboard.host
    access = Access.of(host, allow_control=arguments.allow_control)
    certificate_for(config.hub, Holder.WATCHER)  # so that what is wrong with it is told now
    if access.control:
        certificate_for(config.hub, Holder.OPERATOR)
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    with heartbeat(lifecycle):
        if not is_supervised():
            _check_there_is_a_run(config)
        listening = _listen(host, arguments.port, config, lifecycle)
        if listening is None:
            return 0
        source = RunSource(config, make_task(config.task))
        with (
            Videos(config) as videos,
            serving(make_app(source, access, videos), listening),
            source.following(lifecycle),
        ):
            print(f"run {config.run.name}: {address_of(listening)}", flush=True)
            while not lifecycle.stopping:
                lifecycle.wait(METRICS_PERIOD_S)
    return 0


def _check_there_is_a_run(config: Config) -> None:
    """Check that there is something to show: the run's folder, or a process of the run.

    Raises:
        UserError: there is neither.
    """
    if config.run_folder.is_dir():
        return
    with open_bus(config.hub, config.run.name, Role.WATCH, f"dashboard-{os.getpid()}") as bus:
        if not Board(bus).wait_for_all(PRESENT_WITHIN_S).metrics:
            raise UserError(
                f"there is nothing of run {config.run.name!r}: no process of it replies at "
                f"{config.hub.endpoint}, and there is no folder {config.run_folder}. Is that the "
                "run's name? Choose another with --set run.name=NAME or --config RUN/config.yaml"
            )


def _listen(
    host: str, port: int | None, config: Config, lifecycle: Lifecycle
) -> socket.socket | None:
    """Listen; under a supervisor wait for a port that is taken. None if it should stop before.

    Raises:
        UserError: nothing can listen there.
    """
    wanted = config.dashboard.port if port is None else port
    while not lifecycle.stopping:
        try:
            listening = listening_socket(host, wanted, or_another=port is None)
        except PortTakenError as error:
            if not is_supervised():
                raise
            LOG.warning("%s. Waiting, and trying again", error)
            lifecycle.wait(TRY_AGAIN_S)
        else:
            if listening.getsockname()[1] != wanted and wanted:
                LOG.warning("port %d is taken, so the page has another", wanted)
            return listening
    return None
