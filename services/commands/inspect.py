"""`vmdnn inspect`: print the network's subnets, or what a checkpoint says about itself."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from learner.checkpoint import load_checkpoint
from learner.subnets import Subnet, subnets
from services.commands.options import add_config, config_of


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    things = parser.add_subparsers(dest="thing", metavar="THING", required=True)
    network = things.add_parser("network", help="the subnets that a config describes")
    add_config(network)
    checkpoint = things.add_parser("checkpoint", help="the metadata of a policy or checkpoint")
    checkpoint.add_argument("file", type=Path, metavar="FILE", help="a .safetensors file")
    for thing in (network, checkpoint):
        thing.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(arguments: argparse.Namespace) -> int:
    """Print the subnets or the metadata."""
    if arguments.thing == "network":
        network = subnets(config_of(arguments).network).values()
        rows = [_subnet_row(subnet) for subnet in network]
        if arguments.json:
            print(json.dumps(rows, indent=2))
        else:
            _print_subnets(rows)
        return 0
    metadata = load_checkpoint(arguments.file).metadata.model_dump(mode="json")
    if arguments.json:
        print(json.dumps(metadata, indent=2))
    else:
        for name, value in metadata.items():
            print(f"{name:14} {value}")
    return 0


def _subnet_row(subnet: Subnet) -> dict[str, Any]:
    """One subnet; sizes as in the paper: (maps, width, height), kernels (width, height)."""
    return {
        "name": subnet.name,
        "symbol": subnet.symbol,
        "shape": _paper_shape(subnet),
        "tau": subnet.tau,
        "kernel": subnet.kernel,
        "stride": subnet.stride,
        "weights": subnet.weights,
        "biases": subnet.biases,
    }


def _paper_shape(subnet: Subnet) -> tuple[int, ...]:
    if len(subnet.shape) < 3:
        return subnet.shape
    maps, height, width = subnet.shape
    return maps, width, height


def _print_subnets(rows: list[dict[str, Any]]) -> None:
    table = Table(
        box=SIMPLE,
        padding=(0, 1, 0, 0),
        caption="shape: maps x width x height; kernel: width x height",
    )
    for column in rows[0]:
        table.add_column(column, no_wrap=True)
    for row in rows:
        table.add_row(*(_cell(value) for value in row.values()))
    table.add_section()
    table.add_row(
        "all", *[""] * 5, *(str(sum(row[key] for row in rows)) for key in ("weights", "biases"))
    )
    Console().print(table)


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, tuple):
        return " x ".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
