"""`vmdnn actor`."""

from __future__ import annotations

import argparse
import os
from functools import partial
from typing import Final

from actors.actor import Actor
from proto.keys import Role
from services.arguments.common import add_joining, add_process
from services.arguments.process import run_process

NICENESS: Final = 10
"""Nice value of actors: the learner has priority, because all actors wait for its policies."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_process(parser)
    add_joining(parser)
    parser.add_argument(
        "--backend",
        help="this actor's simulator; without it, simulator.backend of the configuration",
    )


def run(arguments: argparse.Namespace) -> int:
    """Play episodes until the process is stopped."""
    os.nice(NICENESS)
    return run_process(arguments, Role.ACTOR, partial(Actor, backend=arguments.backend))
