"""`vmdnn metrics`: tell the metrics of a whole run to a monitoring system."""

from __future__ import annotations

import argparse
import logging
import os

from proto.bus import Bus, join_hub
from proto.keys import Role
from proto.lifecycle import Lifecycle
from services.arguments.common import add_connection, add_log_options, config_of, listening_address
from services.arguments.logs import ProcessLog
from services.board import Board, RunView
from services.monitoring.exporter import RunCollector, served

LOG = logging.getLogger(__name__)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_connection(parser)
    add_log_options(parser)
    parser.add_argument(
        "--prometheus",
        type=listening_address,
        required=True,
        metavar="[HOST:]PORT",
        help="where Prometheus fetches the metrics; without HOST, only from this machine",
    )


def run(arguments: argparse.Namespace) -> int:
    """Serve the metrics until Ctrl-C; a hub that does not answer is waited for."""
    log = ProcessLog("metrics", arguments)
    config = config_of(arguments)
    log.run, log.id = config.run.name, f"metrics-{os.getpid()}"
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    watched = _WatchedRun()
    host, port = arguments.prometheus
    collector = RunCollector(config.run.name, watched.view, watched.connected)
    with served(collector, host, port) as chosen:
        LOG.info("metrics of the run %s at http://%s:%d/metrics", config.run.name, host, chosen)
        bus = join_hub(config.hub, config.run.name, Role.WATCH, log.id, lifecycle)
        if bus is not None:
            with bus:
                watched.join(bus)
                while not lifecycle.stopping:
                    lifecycle.wait(1.0)
    return 0


class _WatchedRun:
    """A run that is watched as soon as there is a hub."""

    def __init__(self) -> None:
        self._joined: tuple[Bus, Board] | None = None

    def join(self, bus: Bus) -> None:
        """Watch the run from now on."""
        self._joined = bus, Board(bus)

    def view(self) -> RunView | None:
        """What is known of the run; None before there was a hub."""
        return None if self._joined is None else self._joined[1].view()

    def connected(self) -> bool:
        """Whether the hub is there."""
        return self._joined is not None and not self._joined[0].hub_is_away
