"""What the commands share that train and test many networks: arguments, progress, Ctrl-C."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from learner.tutoring.store import TutoringStore
from services.arguments.common import positive, seed
from services.arguments.training import interruption
from services.terminal.progress import progress_bar
from services.trials import sweeps as sweep
from services.trials.success import READINGS, Tally
from services.trials.sweeps import Member, Tested, Variant

Stores = tuple[TutoringStore, TutoringStore | None]
"""Sequences for coupled training, and those for pre-training if they are others."""


def add_sweep(parser: argparse.ArgumentParser, *, trials: int) -> None:
    """Add --seeds, --trials and --trial-seed; `trials` is how many there are by default."""
    parser.add_argument(
        "--seeds", type=seed, nargs="+", default=[1, 2, 3], help="seeds of the trainings"
    )
    parser.add_argument(
        "--trials", type=positive, default=trials, help="situations for each network"
    )
    parser.add_argument(
        "--trial-seed", type=seed, default=1000, help="seed of the situations, the same for all"
    )


def run_sweep(
    arguments: argparse.Namespace,
    variants: Sequence[Variant],
    work: Path,
    stores_of: Callable[[Variant], Stores],
) -> list[Tested]:
    """Train and test what is missing in a folder, with progress bars; every network that there is.

    Args:
        arguments: those of `add_sweep` and `options.add_playing`.
        variants: what is trained and tested, each with every seed.
        work: the folder.
        stores_of: the sequences that a variant learns from.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; what was done is in the folder.
    """
    members = sweep.members_of(variants, arguments.seeds, work)
    console = Console(stderr=True)
    tested = []
    try:
        for number, member in enumerate(members, 1):
            name = f"{member.variant.name}, seed {member.seed} ({number} of {len(members)})"
            _train(member, stores_of, name)
            tested.append(_test(member, arguments, name))
            console.print(f"{name}: {_counts(tested[-1])}", highlight=False)
    except KeyboardInterrupt:
        console.print(f"stopped; the same command goes on with what is in {work}")
        raise
    return tested


def _train(member: Member, stores_of: Callable[[Variant], Stores], name: str) -> None:
    done, total = sweep.epochs_done(member), sweep.epochs_of(member)
    if done == total:
        return
    stores = stores_of(member.variant)
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
