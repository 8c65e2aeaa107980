"""`vmdnn learner`."""

from __future__ import annotations

import argparse
from functools import partial

from actors.tasks.registry import TASKS
from learner.learner import Learner
from proto.keys import Role
from services.arguments.common import add_process
from services.arguments.process import run_process


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_process(parser)


def run(arguments: argparse.Namespace) -> int:
    """Learn until told to stop."""
    tasks = {name: task() for name, task in TASKS.items()}
    return run_process(arguments, Role.LEARNER, partial(Learner, tasks=tasks))
