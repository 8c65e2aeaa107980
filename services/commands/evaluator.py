"""`vmdnn evaluator`."""

from __future__ import annotations

import argparse

from actors.tasks.registry import make_task
from proto.bus import Bus
from proto.config import Config
from proto.keys import Role
from proto.lifecycle import Lifecycle
from services.arguments.common import add_joining, add_process
from services.arguments.process import run_process
from services.evaluator import Evaluator


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_process(parser)
    add_joining(parser)


def run(arguments: argparse.Namespace) -> int:
    """Evaluate policies until the process is stopped."""
    return run_process(arguments, Role.EVALUATOR, _make_evaluator)


def _make_evaluator(config: Config, bus: Bus, lifecycle: Lifecycle) -> Evaluator:
    """Make an evaluator with the task of the run."""
    return Evaluator(config, bus, lifecycle, task=make_task(config.task))
