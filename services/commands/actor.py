"""`vmdnn actor`."""

from __future__ import annotations

import argparse
import os
from typing import Final

from actors.actor import Actor
from proto.bus import open_bus
from proto.keys import Role
from proto.membership import Lifecycle, own_id
from services.arguments.common import add_process, config_of, start_logging

NICENESS: Final = 10
"""Where cores are few, the learner comes first: everyone waits for its next policy."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_process(parser)


def run(arguments: argparse.Namespace) -> int:
    """Play until told to stop."""
    start_logging("actor")
    os.nice(NICENESS)
    config = config_of(arguments)
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    with (
        own_id(config.run_folder, Role.ACTOR, arguments.id) as process,
        open_bus(config.hub, config.run.name, Role.ACTOR, process) as bus,
    ):
        Actor(config, bus, lifecycle).run()
    return 0
