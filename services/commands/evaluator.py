"""`vmdnn evaluator`."""

from __future__ import annotations

import argparse

from proto.bus import open_bus
from proto.keys import Role
from proto.membership import Lifecycle, only_one
from services.arguments.common import add_process, config_of, start_logging
from services.evaluator import Evaluator


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_process(parser)


def run(arguments: argparse.Namespace) -> int:
    """Evaluate until told to stop."""
    start_logging("evaluator")
    config = config_of(arguments)
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    process = arguments.id or "evaluator"
    with (
        only_one(config.run_folder, Role.EVALUATOR, "evaluator"),
        open_bus(config.hub, config.run.name, Role.EVALUATOR, process) as bus,
    ):
        Evaluator(config, bus, lifecycle).run()
    return 0
