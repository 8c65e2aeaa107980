"""`vmdnn figure time-constants`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from rich.console import Console

from learner.store import TutoringStore
from services import sweep
from services.commands.figures.drawn import Drawn
from services.commands.options import add_config, add_playing, playing_config, positive
from services.commands.training_options import add_training_data, interruption, training_stores
from services.figures import time_constants
from services.progress import progress_bar
from services.success import READINGS, Tally
from services.sweep import Member, Tested

SUMMARY: Final = "train and test networks by their PFC's time constant (paper, figure 5)"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the figure's arguments."""
    add_config(parser)
    add_playing(parser)
    add_training_data(parser)
    parser.add_argument(
        "--tau",
        type=float,
        nargs="+",
        default=[30.0, 70.0, 110.0, 150.0, 210.0],
        help="time constants of the PFC",
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[1, 2, 3], help="seeds of the trainings"
    )
    parser.add_argument("--trials", type=positive, default=52, help="situations for each network")
    parser.add_argument(
        "--trial-seed", type=int, default=1000, help="seed of the situations, the same for all"
    )
    parser.add_argument(
        "--work",
        type=Path,
        help="folder of the networks and their trials, where the same command goes on;"
        " without it, --out without .png",
    )


def draw(arguments: argparse.Namespace) -> Drawn:
    """Train and test what is missing, then draw all."""
    config = playing_config(arguments)
    stores = training_stores(arguments)
    work = arguments.work or arguments.out.with_suffix("")
    members = sweep.members_of(config, arguments.tau, arguments.seeds, work)
    console = Console(stderr=True)
    tested = []
    try:
        for number, member in enumerate(members, 1):
            name = f"tau {member.tau:g}, seed {member.seed} ({number} of {len(members)})"
            _train(member, stores, name)
            tested.append(_test(member, arguments, name))
            console.print(f"{name}: {_counts(tested[-1])}", highlight=False)
    except KeyboardInterrupt:
        console.print(f"stopped; the same command goes on with what is in {work}")
        raise
    tallies = time_constants.tallies_of(tested)
    return Drawn(
        time_constants.draw(tallies), time_constants.numbers(tallies), time_constants.table(tallies)
    )


def _train(member: Member, stores: tuple[TutoringStore, TutoringStore | None], name: str) -> None:
    done, total = sweep.epochs_done(member), sweep.epochs_of(member)
    if done == total:
        return
    with interruption() as interrupted, progress_bar(f"{name}: training", total) as advance:

        def go_on(_loss: float) -> bool:
            advance()
            return not interrupted()

        for _ in range(done):
            advance()
        if not sweep.train(member, *stores, go_on):
            raise KeyboardInterrupt


def _test(member: Member, arguments: argparse.Namespace, name: str) -> Tested:
    with progress_bar(f"{name}: trials", arguments.trials) as advance:
        return sweep.test(
            member,
            arguments.trials,
            arguments.trial_seed,
            workers=arguments.workers,
            on_trial=advance,
        )


def _counts(tested: Tested) -> str:
    tally = Tally.of(tested.outcomes)
    counts = ", ".join(f"{reading} {tally.successes[reading]}" for reading in READINGS)
    return f"{counts} of {tally.trials}"
