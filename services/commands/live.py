"""`vmdnn live`: show in Foxglove what the actors of a run do, as they do it."""

from __future__ import annotations

import argparse
import os

from proto.bus import join_hub
from proto.keys import Role
from proto.lifecycle import Lifecycle
from services.arguments.common import add_connection, add_log_options, config_of, listening_address
from services.arguments.logs import ProcessLog
from services.monitoring.live_view import LiveView


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_connection(parser)
    add_log_options(parser)
    parser.add_argument(
        "--port",
        type=listening_address,
        default="8765",
        metavar="[HOST:]PORT",
        help="where Foxglove connects; without HOST, only from this machine",
    )
    parser.add_argument(
        "--actor", help="id of the actor that the plain topics show; without it, the first"
    )


def run(arguments: argparse.Namespace) -> int:
    """Serve viewers until Ctrl-C; a hub that does not answer is waited for."""
    log = ProcessLog("live", arguments)
    config = config_of(arguments)
    log.run, log.id = config.run.name, f"live-{os.getpid()}"
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    host, port = arguments.port
    bus = join_hub(config.hub, config.run.name, Role.WATCH, log.id, lifecycle)
    if bus is not None:
        with bus:
            period_s = config.simulator.control_period_s
            view = LiveView(bus, period_s=period_s, actor=arguments.actor)
            view.serve(lifecycle, host, port)
    return 0
