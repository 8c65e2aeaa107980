"""Command-line arguments that several subcommands share, and the configuration they select."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from proto.config import Config, HubConfig, load_config
from proto.errors import UserError

INTERRUPTED: Final = 130
"""Exit status of a command that Ctrl-C stopped."""
LARGEST_SEED: Final = 2**32 - 1
LARGEST_PORT: Final = 65_535
_BUILT_IN: Final = Path(str(files("deploy")), "config")


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add --config and --set."""
    parser.add_argument(
        "--config",
        type=config_argument,
        metavar="FILE|NAME",
        help="YAML file, or a built-in configuration such as experiment1 or smoke; without it, all"
        " defaults",
    )
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
        type=endpoint,
        metavar="tcp/HOST:PORT|tls/HOST:PORT",
        help="endpoint of the hub; without it, hub.endpoint of the configuration. tls/ also sets"
        " hub.security=mutual-tls",
    )


def endpoint(text: str) -> str:
    """`type=` of an argument that is the endpoint of a hub."""
    try:
        return HubConfig(endpoint=text).endpoint
    except ValidationError:
        host = text.rpartition("/")[2].partition(":")[0] or "HOST"
        port = text.rpartition(":")[2] if re.search(r":\d+$", text) else "7447"
        raise argparse.ArgumentTypeError(
            f"{text!r} is not an endpoint: write tcp/HOST:PORT, such as tcp/{host}:{port}"
        ) from None


def add_process(parser: argparse.ArgumentParser) -> None:
    """Add --config, --set, --connect, --id and options of the log, for a process on the bus."""
    add_connection(parser)
    parser.add_argument("--id", type=_id, help="name of this process on the bus")
    add_log_options(parser)


def add_log_options(parser: argparse.ArgumentParser) -> None:
    """Add options of the log, see `services.arguments.logs.ProcessLog`."""
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument("-v", "--verbose", action="store_true", help="log details, too")
    amount.add_argument("-q", "--quiet", action="store_true", help="log warnings and errors only")
    parser.add_argument(
        "--log-format",
        choices=("text", "json"),
        default="text",
        help="json: one object for each record, with run, role and id",
    )


def listening_address(text: str) -> tuple[str, int]:
    """`type=` of an argument `[HOST:]PORT`; without a host, an address of this machine only."""
    host, _, port = text.rpartition(":")
    if not re.fullmatch(r"[0-9]{1,5}", port) or int(port) > LARGEST_PORT:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no port; write a port such as 9464, or HOST:PORT"
        )
    return host.strip("[]") or "127.0.0.1", int(port)


def add_joining(parser: argparse.ArgumentParser) -> None:
    """Add --run, for a process that can take the run's configuration from the bus."""
    parser.add_argument(
        "--run",
        dest="run_name",
        metavar="NAME",
        help="name of the run, whose configuration comes from its learner; instead of --config",
    )


def config_file(name: str) -> Path:
    """Return the file of a configuration.

    Args:
        name: a path, or the name of a built-in configuration.

    Raises:
        UserError: there is neither a file nor a built-in configuration of this name.
    """
    path = Path(name)
    if path.is_file() or path.suffix or path.name != name:  # a run may have a folder of that name
        return path
    if name not in built_in_names():
        raise UserError(
            f"config file {name} does not exist; built in are: {', '.join(built_in_names())}"
        )
    return _BUILT_IN / f"{name}.yaml"


def built_in_names() -> list[str]:
    """Names of the built-in configurations."""
    return sorted(file.stem for file in _BUILT_IN.glob("*.yaml"))


def config_argument(name: str) -> Path:
    """`config_file`, for `type=` of an argument."""
    try:
        return config_file(name)
    except UserError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def config_of(arguments: argparse.Namespace) -> Config:
    """Load the configuration that --config, --set and, if present, --connect and --run select."""
    return load_config(arguments.config, overrides_of(arguments))


def overrides_of(arguments: argparse.Namespace) -> list[str]:
    """Return the overrides that --set and, if present, --connect and --run select.

    Raises:
        UserError: there is both --config and --run.
    """
    overrides = list(arguments.overrides)
    if getattr(arguments, "connect", None) is not None:
        overrides.append(f"hub.endpoint={arguments.connect}")
        if arguments.connect.startswith("tls/"):
            overrides.append("hub.security=mutual-tls")
    if getattr(arguments, "run_name", None) is not None:
        if arguments.config is not None:
            raise UserError("--run takes the run's configuration from its learner: no --config")
        overrides.append(f"run.name={arguments.run_name}")
    return overrides


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
    """Load the configuration that the arguments of `add_config` and `add_playing` select.

    Args:
        arguments: the parsed arguments.
        overrides: further `key.path=value` overrides.
    """
    options = {"task.name": arguments.task, "simulator.backend": arguments.backend}
    given = [f"{key}={value}" for key, value in options.items() if value is not None]
    return load_config(arguments.config, [*arguments.overrides, *given, *overrides])


def integer(least: int, most: int | None = None) -> Callable[[str], int]:
    """Return the `type=` of an argument that is an integer in least..most (None: unlimited)."""
    limits = f"of at least {least}" if most is None else f"from {least} to {most}"

    def number(text: str) -> int:
        value = int(text) if re.fullmatch(r"[-+]?[0-9]{1,18}", text) else None
        if value is None or value < least or (most is not None and value > most):
            raise argparse.ArgumentTypeError(f"{text!r} is not an integer {limits}")
        return value

    return number


seed = integer(0, LARGEST_SEED)
"""`type=` of an argument that is a seed."""
positive = integer(1)
"""`type=` of an argument that is a positive integer."""
