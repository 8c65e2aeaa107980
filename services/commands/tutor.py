"""`vmdnn tutor`: record tutored sequences, without the bus; those of the tutor, or a person's."""

from __future__ import annotations

import argparse
import json
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Final

from actors.tasks.registry import make_task
from proto.errors import UserError
from proto.keys import Role
from services.arguments.common import (
    LARGEST_PORT,
    add_config,
    add_playing,
    endpoint,
    integer,
    playing_config,
    positive,
    seed,
)
from services.arguments.logs import start_logging
from services.arguments.process import run_process
from services.playing.tutoring import parse_cases, record, tutoring_jobs
from services.terminal.console import make_console
from services.terminal.progress import progress_bar
from services.terminal.tables import success_table
from services.trials.success import Tally

ALL: Final = "all"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    add_config(parser)
    add_playing(parser)
    parser.add_argument(
        "--cases",
        default=ALL,
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
    parser.add_argument("--out", type=Path, help="folder of the recordings")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument(
        "--by-hand",
        action="store_true",
        help="a person tutors in the browser; the command serves the page",
    )
    parser.add_argument(
        "--port",
        type=integer(0, LARGEST_PORT),
        help="with --by-hand, port of the page, 0 for any free one; without it, dashboard.port of"
        " the configuration, or the next free one",
    )
    parser.add_argument(
        "--policy",
        help="with --by-hand, a policy that acts until the person takes over: pretrained:NAME, a"
        " checkpoint's file, or the folder of a run; what is recorded are corrections of it",
    )
    parser.add_argument(
        "--connect",
        type=endpoint,
        metavar="tcp/HOST:PORT|tls/HOST:PORT",
        help="with --by-hand, endpoint of the hub of a run: the person shows what its learner asks"
        " for, cases and corrections, and the learner keeps it; --out and --cases do not apply",
    )


def run(arguments: argparse.Namespace) -> int:
    """Record the sequences that the folder does not have yet, and print the tutor's success.

    Raises:
        UserError: options contradict each other, or it cannot be recorded there.
    """
    if arguments.by_hand:
        return _run_by_hand(arguments)
    for option in ("port", "policy", "connect"):
        if getattr(arguments, option) is not None:
            raise UserError(f"--{option} belongs to --by-hand: add --by-hand, or leave it out")
    _check_has_folder(arguments)
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


def _run_by_hand(arguments: argparse.Namespace) -> int:
    given = {"--repeats": arguments.repeats is not None, "--json": arguments.json}
    if arguments.connect is not None:
        given |= {
            "--out": arguments.out is not None,
            "--policy": arguments.policy is not None,
            "--cases": arguments.cases != ALL,
        }
        if unfit := [option for option, is_given in given.items() if is_given]:
            raise UserError(f"{unfit[0]} is of no use with --connect: the run's learner decides")
        return _run_in_run(arguments)
    if unfit := [option for option, is_given in given.items() if is_given]:
        raise UserError(f"{unfit[0]} is of no use with --by-hand: a person shows what they like")
    _check_has_folder(arguments)
    # The page needs a web server, which nothing else here does.
    from services.by_hand.tutoring import tutor_by_hand  # noqa: PLC0415

    start_logging("tutor")
    config = playing_config(arguments)
    cases = parse_cases(arguments.cases, make_task(config.task), arguments.seed)
    kept = tutor_by_hand(config, cases, arguments.out, arguments.port, arguments.policy)
    print(f"{arguments.out} has {kept} sequences that were tutored by hand")
    return 0


def _run_in_run(arguments: argparse.Namespace) -> int:
    """Take part in a run, as an actor whose tutor is a person."""
    from services.by_hand.tutoring import TutoredActor  # noqa: PLC0415 - see above

    if arguments.task is not None:
        arguments.overrides.append(f"task.name={arguments.task}")
    process = argparse.Namespace(
        config=arguments.config,
        overrides=arguments.overrides,
        connect=arguments.connect,
        id=None,
        verbose=False,
        quiet=False,
        log_format="text",
    )
    make = partial(TutoredActor, port=arguments.port, backend=arguments.backend)
    return run_process(process, Role.ACTOR, make)


def _check_has_folder(arguments: argparse.Namespace) -> None:
    """Refuse to record without a folder.

    Raises:
        UserError: there is none.
    """
    if arguments.out is None:
        raise UserError("say where to record: --out FOLDER")
