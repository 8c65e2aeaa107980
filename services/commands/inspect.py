"""`vmdnn inspect`: the network's subnets, what a checkpoint says, and what its vision tells."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from learner.checkpoint import load_checkpoint
from learner.network.subnets import Subnet, subnets
from learner.network.vision_probe import Answer, Probe, Vision, ask_classifier, probe
from learner.tutoring.store import TutoringStore
from proto.episode import Episode
from services.arguments.common import add_config, config_of
from services.arguments.training import filled_store


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    things = parser.add_subparsers(dest="thing", metavar="THING", required=True)
    network = things.add_parser("network", help="the subnets that a config describes")
    add_config(network)
    checkpoint = things.add_parser("checkpoint", help="the metadata of a policy or checkpoint")
    checkpoint.add_argument("file", type=Path, metavar="FILE", help="a .safetensors file")
    vision = things.add_parser("vision", help="what can be told of situations from V_S")
    vision.add_argument(
        "file",
        type=Path,
        metavar="FILE",
        help="a .safetensors file; checkpoints/pretraining.safetensors of a run has the classifier",
    )
    vision.add_argument(
        "--data", type=Path, required=True, help="folder of the sequences that are learned from"
    )
    vision.add_argument(
        "--test", type=Path, required=True, help="folder of sequences of other situations"
    )
    for thing in (network, checkpoint, vision):
        thing.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(arguments: argparse.Namespace) -> int:
    """Print the subnets, the metadata or what the vision tells."""
    if arguments.thing == "vision":
        _print_vision(arguments)
        return 0
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


def _print_vision(arguments: argparse.Namespace) -> None:
    vision = Vision(load_checkpoint(arguments.file))
    learned = _episodes(filled_store("--data", arguments.data))
    tested = _episodes(filled_store("--test", arguments.test))
    answers, probes = ask_classifier(vision, tested), probe(vision, learned, tested)
    if arguments.json:
        found = {"sequences": len(tested), "classifier": answers, "regression": probes}
        print(json.dumps(found, indent=2, default=asdict))
        return
    console = Console()
    if answers:
        console.print(_answer_table(answers, len(tested)))
    console.print(_probe_table(probes, len(learned), len(tested)))


def _episodes(store: TutoringStore) -> list[Episode]:
    return list(filter(None, map(store.load, store.ids)))


def _answer_table(answers: Sequence[Answer], sequences: int) -> Table:
    table = Table(box=SIMPLE, title=f"The classifier, {sequences} sequences", title_justify="left")
    for column in ("value", "classes", "nearest class %", "mean error"):
        table.add_column(column, justify="left" if column == "value" else "right", no_wrap=True)
    for answer in answers:
        right = f"{100 * answer.right:.1f}"
        error = "" if answer.error is None else _amount(answer.value, answer.error)
        table.add_row(answer.value, str(answer.classes), right, error)
    return table


def _probe_table(probes: Sequence[Probe], learned: int, tested: int) -> Table:
    """A row for each phase, a column for each value."""
    values = list(dict.fromkeys(probe.value for probe in probes))
    table = Table(
        box=SIMPLE,
        title=f"Linear regression from V_S at the end of each phase, learned from {learned}"
        f" sequences: mean error on {tested} others",
        title_justify="left",
    )
    table.add_column("phase", no_wrap=True)
    for value in values:
        table.add_column(value, justify="right", no_wrap=True)
    for number, (phase, group) in enumerate(groupby(probes, lambda probe: probe.phase), 1):
        errors = (_amount(probe.value, probe.error) for probe in group)
        table.add_row(f"{number} {phase}", *errors)
    blind = {probe.value: probe.blind_error for probe in probes}
    table.add_section()
    table.add_row("without seeing", *(_amount(value, blind[value]) for value in values))
    return table


def _amount(value: str, error: float) -> str:
    """An error of a value in the unit that people use for it."""
    if value.endswith("_m"):
        return f"{1e3 * error:.1f} mm"
    return f"{error:.2f} deg" if value.endswith("_deg") else f"{error:.3g}"


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
