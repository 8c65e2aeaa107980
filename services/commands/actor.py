"""`vmdnn actor`."""

from __future__ import annotations

import argparse
import os
from typing import Final

from actors.actor import Actor
from proto.keys import Role
from services.arguments.common import add_process
from services.arguments.process import run_process

NICENESS: Final = 10
"""Where cores are few, the learner comes first: all actors wait for its next policy."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_process(parser)


def run(arguments: argparse.Namespace) -> int:
    """Play until told to stop."""
    os.nice(NICENESS)
    return run_process(arguments, Role.ACTOR, Actor)
