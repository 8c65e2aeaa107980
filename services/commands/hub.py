"""`vmdnn hub`."""

from __future__ import annotations

import argparse

from proto.membership import Lifecycle
from services.arguments.common import add_process, config_of, start_logging
from services.hub import Hub


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_process(parser)


def run(arguments: argparse.Namespace) -> int:
    """Listen at the endpoint until told to stop."""
    start_logging("hub")
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    Hub(config_of(arguments), arguments.id or "hub").run(lifecycle)
    return 0
