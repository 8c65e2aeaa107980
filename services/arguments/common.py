"""Arguments that several subcommands take, and what they mean."""

from __future__ import annotations

import argparse
import logging
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from proto.config import Config, load_config

LARGEST_SEED: Final = 2**32 - 1


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add --config and --set."""
    parser.add_argument("--config", type=Path, help="YAML file; without it, all defaults")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="override a value, such as learner.rate=1e-3; may be repeated",
    )


def add_connection(parser: argparse.ArgumentParser) -> None:
    """Add --config, --set and --connect, for a command that uses the bus."""
    add_config(parser)
    parser.add_argument(
        "--connect",
        metavar="tcp/HOST:PORT",
        help="where the hub listens; without it, hub.endpoint of the configuration",
    )


def add_process(parser: argparse.ArgumentParser) -> None:
    """Add --config, --set, --connect and --id, for a process on the bus."""
    add_connection(parser)
    parser.add_argument("--id", type=_id, help="name of this process on the bus")


def config_of(arguments: argparse.Namespace) -> Config:
    """The configuration that the arguments of `add_config`, or of more than these, ask for."""
    overrides = list(arguments.overrides)
    if getattr(arguments, "connect", None) is not None:
        overrides.append(f"hub.endpoint={arguments.connect}")
    return load_config(arguments.config, overrides)


def start_logging(role: str) -> None:
    """Log to standard error; each line has the time and the role."""
    logging.basicConfig(
        level=logging.INFO, format=f"%(asctime)s {role} %(levelname)s %(message)s", force=True
    )


def _id(text: str) -> str:
    if re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", text) is None:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not an id: letters, digits, dots, dashes, underscores, at most 64"
        )
    return text


def add_playing(parser: argparse.ArgumentParser) -> None:
    """Add --task, --backend and --workers, for a command that plays episodes without the bus."""
    parser.add_argument("--task", help="task to play; without it, task.name of the configuration")
    parser.add_argument(
        "--backend", help="simulator; without it, simulator.backend of the configuration"
    )
    parser.add_argument(
        "--workers",
        type=positive,
        default=len(os.sched_getaffinity(0)),
        help="processes to play in",
    )


def playing_config(arguments: argparse.Namespace, overrides: Sequence[str] = ()) -> Config:
    """The configuration that the arguments of `add_config` and `add_playing` ask for."""
    asked = {"task.name": arguments.task, "simulator.backend": arguments.backend}
    named = [f"{key}={value}" for key, value in asked.items() if value is not None]
    return load_config(arguments.config, [*arguments.overrides, *named, *overrides])


def seed(text: str) -> int:
    """A seed, for `type=` of an argument."""
    return _integer(text, 0, LARGEST_SEED)


def positive(text: str) -> int:
    """An integer of at least one, for `type=` of an argument."""
    return _integer(text, 1, None)


def _integer(text: str, least: int, most: int | None) -> int:
    """Raises argparse.ArgumentTypeError if the text is no integer in least..most."""
    number = int(text) if re.fullmatch(r"[-+]?[0-9]{1,18}", text) else None
    if number is None or number < least or (most is not None and number > most):
        limits = f"of at least {least}" if most is None else f"from {least} to {most}"
        raise argparse.ArgumentTypeError(f"{text!r} is not an integer {limits}")
    return number
