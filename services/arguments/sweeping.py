"""Arguments and progress of the commands that train and test many networks."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from learner.tutoring.store import TutoringStore
from services.arguments.common import positive, seed
from services.arguments.training import interruption
from services.terminal.console import make_console
from services.terminal.progress import progress_bar
from services.trials import sweeps
from services.trials.success import READINGS, Tally
from services.trials.sweeps import RunOutcomes, SweepRun, Variant

Stores = tuple[TutoringStore, TutoringStore | None]
"""Sequences for coupled training, and for pre-training; None for the same sequences."""


def add_sweep(parser: argparse.ArgumentParser, *, trials: int) -> None:
    """Add --seeds, --trials (with the default `trials`) and --trial-seed."""
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
) -> list[RunOutcomes]:
    """Train and test networks with progress bars; continue with the results in a folder.

    Args:
        arguments: the parsed arguments of `add_sweep` and `common.add_playing`.
        variants: the networks, each trained with every seed.
        work: the folder of networks and trials. Networks and trials in it are not repeated.
        stores_of: returns the sequences that a variant learns from.

    Returns:
        The results of all networks.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; the results so far are in the folder.
    """
    runs = sweeps.open_runs(variants, arguments.seeds, work)
    console = make_console(stderr=True)
    tested = []
    try:
        for number, run in enumerate(runs, 1):
            name = f"{run.variant.name}, seed {run.seed} ({number} of {len(runs)})"
            _train(run, stores_of, name)
            tested.append(_play_trials(run, arguments, name))
            console.print(f"{name}: {_counts(tested[-1])}", highlight=False)
    except KeyboardInterrupt:
        console.print(f"stopped; the same command continues with the results in {work}")
        raise
    return tested


def _train(run: SweepRun, stores_of: Callable[[Variant], Stores], name: str) -> None:
    done, total = sweeps.epochs_done(run), sweeps.epochs_total(run)
    if done == total:
        return
    stores = stores_of(run.variant)
    with interruption() as interrupted, progress_bar(f"{name}: training", total) as advance:

        def go_on(_loss: float) -> bool:
            advance()
            return not interrupted()

        for _ in range(done):
            advance()
        if not sweeps.train(run, *stores, go_on):
            raise KeyboardInterrupt


def _play_trials(run: SweepRun, arguments: argparse.Namespace, name: str) -> RunOutcomes:
    with progress_bar(f"{name}: trials", arguments.trials) as advance:
        return sweeps.play_trials(
            run,
            arguments.trials,
            arguments.trial_seed,
            workers=arguments.workers,
            on_trial=advance,
        )


def _counts(tested: RunOutcomes) -> str:
    tally = Tally.of(tested.outcomes)
    counts = ", ".join(f"{reading} {tally.successes[reading]}" for reading in READINGS)
    return f"{counts} of {tally.trials}"
