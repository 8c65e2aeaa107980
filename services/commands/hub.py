"""`vmdnn hub`."""

from __future__ import annotations

import argparse

from proto.keys import Role
from services.arguments.common import add_process
from services.arguments.process import run_process
from services.hub import Hub


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_process(parser)


def run(arguments: argparse.Namespace) -> int:
    """Listen on the endpoint until the process is stopped."""
    return run_process(arguments, Role.HUB, Hub)
