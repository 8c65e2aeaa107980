"""`vmdnn tutor`: record tutored sequences, without the bus."""

from __future__ import annotations

import argparse
import json
from contextlib import closing
from pathlib import Path

from actors.tasks.registry import make_task
from services.arguments.common import add_config, add_playing, playing_config, positive, seed
from services.playing.tutoring import parse_cases, record, tutoring_jobs
from services.terminal.console import make_console
from services.terminal.progress import progress_bar
from services.terminal.tables import success_table
from services.trials.success import Tally


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    add_config(parser)
    add_playing(parser)
    parser.add_argument(
        "--cases",
        default="all",
        help="all tutored cases, or their numbers such as 0,3,7-9, or random:40 for 40 random"
        " situations",
    )
    parser.add_argument(
        "--seed",
        type=seed,
        default=100_000,
        help="seed of the first random situation; the others have the next seeds",
    )
    parser.add_argument(
        "--repeats",
        type=positive,
        help="executions of each case, the first without noise; without it, tutor.repeats of the"
        " configuration",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the recordings")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(arguments: argparse.Namespace) -> int:
    """Record the sequences that the folder does not have yet, and print the tutor's success."""
    repeats = [] if arguments.repeats is None else [f"tutor.repeats={arguments.repeats}"]
    config = playing_config(arguments, repeats)
    cases = parse_cases(arguments.cases, make_task(config.task), arguments.seed)
    jobs = tutoring_jobs(config, cases, arguments.out)
    episodes = record(config, jobs, arguments.out, workers=arguments.workers)
    tally = Tally()
    with progress_bar("tutoring", len(jobs)) as advance, closing(episodes):
        for episode in episodes:
            tally.add(episode.outcome)
            advance()
    if arguments.json:
        print(json.dumps({"folder": str(arguments.out), **tally.as_json()}))
        return 0
    make_console().print(success_table(f"{tally.trials} sequences in {arguments.out}", tally))
    return 0
