"""Arguments that many subcommands share."""

from __future__ import annotations

import argparse
from pathlib import Path

from proto.config import Config, load_config


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


def config_of(arguments: argparse.Namespace) -> Config:
    """The configuration that the arguments of `add_config` ask for."""
    return load_config(arguments.config, arguments.overrides)
