"""`vmdnn inspect`: show a network, a checkpoint, a task, or what the vision represents."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from actors.tasks.registry import make_task
from learner.checkpoint import load_checkpoint
from learner.network.subnets import subnets
from learner.network.vision_probe import Vision, score_classifier, score_regression
from learner.tutoring.store import TutoringStore
from proto.config import load_config
from proto.episode import Episode
from services.arguments.common import add_config, config_of
from services.arguments.training import filled_store
from services.terminal.console import make_console
from services.terminal.network_tables import (
    classifier_table,
    regression_table,
    subnet_numbers,
    subnet_table,
)
from services.terminal.task_tables import task_description, task_table


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    things = parser.add_subparsers(dest="thing", metavar="THING", required=True)
    network = things.add_parser("network", help="the subnets that a config describes")
    network.set_defaults(inspect=_inspect_network)
    add_config(network)
    checkpoint = things.add_parser("checkpoint", help="the metadata of a policy or checkpoint")
    checkpoint.set_defaults(inspect=_inspect_checkpoint)
    checkpoint.add_argument("file", type=Path, metavar="FILE", help="a .safetensors file")
    task = things.add_parser("task", help="a task's variables, phases, cases and baselines")
    task.set_defaults(inspect=_inspect_task)
    add_config(task)
    task.add_argument("--task", help="task; without it, task.name of the configuration")
    vision = things.add_parser("vision", help="how well situations can be read from V_S")
    vision.set_defaults(inspect=_inspect_vision)
    vision.add_argument(
        "file",
        type=Path,
        metavar="FILE",
        help="a .safetensors file; checkpoints/pretraining.safetensors of a run has the classifier",
    )
    vision.add_argument(
        "--data", type=Path, required=True, help="folder of the sequences to learn from"
    )
    vision.add_argument(
        "--test", type=Path, required=True, help="folder of sequences of other situations"
    )
    for thing in (network, checkpoint, task, vision):
        thing.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(arguments: argparse.Namespace) -> int:
    """Print the network's subnets, the checkpoint's metadata, the task, or the vision's scores."""
    arguments.inspect(arguments)
    return 0


def _inspect_network(arguments: argparse.Namespace) -> None:
    network = list(subnets(config_of(arguments).network).values())
    if arguments.json:
        print(json.dumps([subnet_numbers(subnet) for subnet in network], indent=2))
    else:
        make_console().print(subnet_table(network))


def _inspect_checkpoint(arguments: argparse.Namespace) -> None:
    metadata = load_checkpoint(arguments.file).metadata.model_dump(mode="json")
    if arguments.json:
        print(json.dumps(metadata, indent=2))
    else:
        for name, value in metadata.items():
            print(f"{name:14} {value}")


def _inspect_task(arguments: argparse.Namespace) -> None:
    named = [] if arguments.task is None else [f"task.name={arguments.task}"]
    task = make_task(load_config(arguments.config, [*arguments.overrides, *named]).task)
    if arguments.json:
        print(json.dumps(task_description(task), indent=2))
    else:
        make_console().print(task_table(task))


def _inspect_vision(arguments: argparse.Namespace) -> None:
    vision = Vision(load_checkpoint(arguments.file))
    learned = _episodes(filled_store("--data", arguments.data))
    tested = _episodes(filled_store("--test", arguments.test))
    classifier = score_classifier(vision, tested)
    regression = score_regression(vision, learned, tested)
    if arguments.json:
        found = {"sequences": len(tested), "classifier": classifier, "regression": regression}
        print(json.dumps(found, indent=2, default=asdict))
        return
    console = make_console()
    if classifier:
        console.print(classifier_table(classifier, len(tested)))
    console.print(regression_table(regression, len(learned), len(tested)))


def _episodes(store: TutoringStore) -> list[Episode]:
    return list(filter(None, map(store.load, store.ids)))
