"""`vmdnn compare`: train and test VMDNN and other networks on the same data."""

from __future__ import annotations

import argparse
import json
from contextlib import closing
from pathlib import Path

from learner.tutoring.store import TutoringStore
from proto.config import Config
from services.arguments.common import add_config, add_playing, playing_config
from services.arguments.sweeping import Stores, add_sweep, run_sweep
from services.arguments.training import add_training_data, training_stores
from services.terminal.console import make_console
from services.terminal.progress import progress_bar
from services.trials import comparison
from services.trials.comparison import CONTENDERS, FIXED_GAZE
from services.trials.sweeps import Variant


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    add_config(parser)
    add_playing(parser)
    add_training_data(parser)
    parser.add_argument(
        "--only",
        nargs="+",
        choices=tuple(CONTENDERS),
        default=list(CONTENDERS),
        help="networks to compare",
    )
    add_sweep(parser, trials=300)
    parser.add_argument(
        "--work",
        type=Path,
        required=True,
        help="folder of the networks and their trials; the same command continues with it",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(arguments: argparse.Namespace) -> int:
    """Train and test the networks that are not done yet, then print the results of each network."""
    config = playing_config(arguments)
    stores = training_stores(arguments)

    def stores_of(variant: Variant) -> Stores:
        if variant.name != FIXED_GAZE:
            return stores
        return _repeated_stores(stores, variant, config, arguments)

    contenders = comparison.variants(config, arguments.only)
    tested = run_sweep(arguments, contenders, arguments.work, stores_of)
    scores = comparison.scores(tested)
    if arguments.json:
        print(json.dumps(comparison.numbers(scores)))
    else:
        make_console().print(comparison.table(scores))
    return 0


def _repeated_stores(
    stores: Stores, variant: Variant, config: Config, arguments: argparse.Namespace
) -> Stores:
    """Repeat the tutoring of both stores with a robot that does not move its head and focus."""

    def repeat(store: TutoringStore, name: str) -> TutoringStore:
        folder = arguments.work / f"{variant.name}_{name}"
        episodes = comparison.repeat_tutoring(
            store, variant, config, folder, workers=arguments.workers
        )
        label = f"{variant.name}: {name}"
        with progress_bar(label, len(store)) as advance, closing(episodes):
            for _ in episodes:
                advance()
        return TutoringStore(folder)

    coupled, pretraining = stores
    return (
        repeat(coupled, "tutoring"),
        None if pretraining is None else repeat(pretraining, "pretraining"),
    )
