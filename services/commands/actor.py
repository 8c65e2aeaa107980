"""`vmdnn actor`."""

from __future__ import annotations

import argparse
import os
from functools import partial
from typing import Final

from actors.actor import Actor
from proto.keys import Role
from services.arguments.common import add_joining, add_process, integer
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
    parser.add_argument(
        "--drain",
        type=integer(0, 3600),
        default=0,
        metavar="SECONDS",
        help="when it is to stop, play no more but wait at most so long for the receipts of what"
        " is in its outbox; for an actor whose folder is deleted when it has ended",
    )


def run(arguments: argparse.Namespace) -> int:
    """Play episodes until the process is stopped."""
    os.nice(NICENESS)
    make = partial(Actor, backend=arguments.backend, drain_s=arguments.drain)
    return run_process(arguments, Role.ACTOR, make)
