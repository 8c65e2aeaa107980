"""`vmdnn learner`."""

from __future__ import annotations

import argparse

from actors.tasks.registry import make_task
from learner.learner import Learner
from proto.bus import Bus
from proto.config import Config
from proto.keys import Role
from proto.lifecycle import Lifecycle
from services.arguments.common import add_process
from services.arguments.process import run_process


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_process(parser)


def run(arguments: argparse.Namespace) -> int:
    """Learn until the process is stopped."""
    return run_process(arguments, Role.LEARNER, _make_learner)


def _make_learner(config: Config, bus: Bus, lifecycle: Lifecycle) -> Learner:
    """Make a learner with the tasks of coupled training and of pre-training."""
    names = filter(None, (config.task.name, config.pretraining_task))
    tasks = {name: make_task(config.task_called(name)) for name in names}
    return Learner(config, bus, lifecycle, tasks=tasks)
