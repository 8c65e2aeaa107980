"""`vmdnn bench`: measure speed on this machine."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from typing import Any

from actors.bench import ActorSpeed, bench_actor
from services.commands.options import add_config, config_of


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    subjects = parser.add_subparsers(dest="subject", metavar="SUBJECT", required=True)
    actor = subjects.add_parser(
        "actor", help="physics, rendering, the network's step, and the actor's whole loop"
    )
    add_config(actor)
    actor.add_argument("--json", action="store_true", help="print JSON instead of lines")


def run(arguments: argparse.Namespace) -> int:
    """Measure and print."""
    speed = _rounded(bench_actor(config_of(arguments)))
    if arguments.json:
        print(json.dumps(speed))
    else:
        for name, value in speed.items():
            print(f"{name:12} {value}")
    return 0


def _rounded(speed: ActorSpeed) -> dict[str, Any]:
    return {
        name: round(value, 4) if isinstance(value, float) else value
        for name, value in asdict(speed).items()
    }
