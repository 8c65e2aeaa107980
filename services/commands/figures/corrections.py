"""`vmdnn figure corrections`."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Final

from proto.errors import UserError
from proto.seeds import TRIALS_BELOW
from services.arguments.common import positive, seed
from services.figures import corrections
from services.figures.corrections import Curve
from services.figures.figure_result import FigureResult
from services.terminal.console import make_console
from services.terminal.progress import progress_bar
from services.trials.round_trials import Run, open_run
from services.trials.success import Tally
from services.trials.trial_playing import play_missing_trials

SUMMARY: Final = "success against the number of tutored cases, after each round of corrections"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the figure's arguments."""
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folder of a run")
    parser.add_argument("--trials", type=positive, default=300, help="situations for each policy")
    parser.add_argument(
        "--seed", type=seed, default=1000, help="seed of the situations, the same for all"
    )
    parser.add_argument(
        "--workers",
        type=positive,
        default=len(os.sched_getaffinity(0)),
        help="processes to play in",
    )


def draw(arguments: argparse.Namespace) -> FigureResult:
    """Test the policies that were not tested yet, then draw the success of all."""
    if arguments.seed + arguments.trials > TRIALS_BELOW:
        raise UserError(
            f"--seed {arguments.seed}: the run may have been tutored in situations with seeds from"
            f" {TRIALS_BELOW} on; choose a smaller seed"
        )
    runs = [open_run(folder) for folder in arguments.runs]
    try:
        curves = [_curve(run, arguments) for run in runs]
    except KeyboardInterrupt:
        console = make_console(stderr=True)
        console.print(
            "stopped; the same command continues with the trials counted in the runs' folders"
        )
        raise
    return FigureResult(
        corrections.draw(curves),
        {
            "trials": arguments.trials,
            "seed": arguments.seed,
            **corrections.numbers(curves),
        },
        corrections.table(curves),
    )


def _curve(run: Run, arguments: argparse.Namespace) -> Curve:
    tallies = []
    for policy in run.policies:
        label = f"{run.config.run.name}, policy {policy.version}"
        with progress_bar(label, arguments.trials) as advance:
            outcomes = play_missing_trials(
                run.trial_log,
                policy.logged(),
                run.config,
                arguments.trials,
                arguments.seed,
                workers=arguments.workers,
                on_trial=advance,
            )
        tallies.append(Tally.of(outcomes))
    return Curve(run, tallies)
