"""What the commands share that join a run to watch or control it."""

from __future__ import annotations

import argparse
import time
from typing import Final

from proto.bus import Bus, NoHubError, open_bus
from proto.config import Config
from proto.keys import Role
from proto.permissions import Holder
from services.arguments.common import integer

TRY_AGAIN_S: Final = 0.5


def add_wait(parser: argparse.ArgumentParser) -> None:
    """Add --wait, for a command that uses the bus but is no process of a run."""
    parser.add_argument(
        "--wait",
        type=integer(0, 10**6),
        default=0,
        metavar="SECONDS",
        help="how long to wait for a hub that does not answer yet",
    )


def open_bus_within(
    config: Config, process: str, wait_s: float, *, holder: Holder | None = None
) -> Bus:
    """Connect to the hub as a watcher, and wait for it if it does not answer yet.

    Args:
        config: the configuration of the run.
        process: id on the bus.
        wait_s: how long to try again (s).
        holder: whose certificate is shown; None for a watcher's.

    Raises:
        NoHubError: no hub answers in this time.
    """
    over_s = time.monotonic() + wait_s
    while True:
        try:
            return open_bus(config.hub, config.run.name, Role.WATCH, process, holder=holder)
        except NoHubError:
            if time.monotonic() >= over_s:
                raise
            time.sleep(TRY_AGAIN_S)
