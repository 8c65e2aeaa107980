"""`vmdnn recorder`."""

from __future__ import annotations

import argparse

from proto.keys import Role
from services.arguments.common import add_joining, add_process
from services.arguments.process import run_process
from services.recorder import Recorder


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_process(parser)
    add_joining(parser)


def run(arguments: argparse.Namespace) -> int:
    """Record rollouts until the process is stopped."""
    return run_process(arguments, Role.RECORDER, Recorder)
