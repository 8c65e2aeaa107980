"""`vmdnn learner`."""

from __future__ import annotations

import argparse

from actors.tasks.registry import make_task
from learner.learner import Learner
from proto.bus import open_bus
from proto.keys import Role
from proto.membership import Lifecycle, only_one
from services.arguments.common import add_process, config_of, start_logging


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_process(parser)


def run(arguments: argparse.Namespace) -> int:
    """Learn until told to stop."""
    start_logging("learner")
    config = config_of(arguments)
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    names = filter(None, (config.task.name, config.pretraining_task))
    tasks = {name: make_task(config.task_called(name)) for name in names}
    process = arguments.id or "learner"
    with (
        only_one(config.run_folder, Role.LEARNER, "learner"),
        open_bus(config.hub, config.run.name, Role.LEARNER, process) as bus,
    ):
        Learner(config, bus, lifecycle, tasks=tasks).run()
    return 0
