"""`vmdnn evaluate --run`: the trials of a run that its evaluator did not get to."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.table import Table

from proto.config import Config
from proto.errors import UserError
from proto.keys import Role
from proto.run_locks import AlreadyWorksError, single_process
from proto.suites import Suite
from services.arguments.common import INTERRUPTED
from services.terminal.console import make_console
from services.terminal.progress import progress_bar
from services.terminal.rates import rate_text
from services.trials.evaluation import in_world_of
from services.trials.run_folder import RunFolder, trial_log_file
from services.trials.success import READINGS, Tally
from services.trials.trial_playing import play_missing_trials


def evaluate_run(arguments: argparse.Namespace) -> int:
    """Play what is missing of the trials of policy versions, and print what was counted."""
    run = _open(arguments)
    suite = run.config.suites[0] if arguments.suite is None else run.config.suite(arguments.suite)
    versions = run.chosen_versions(arguments.policy_version, suite)
    trials = min(arguments.trials or len(suite.test_seeds), len(suite.test_seeds))
    config = run.config if arguments.backend is not None else in_world_of(suite, run.config)
    status = 0
    try:
        with _no_evaluator(run.folder):
            for version in versions:
                _play(run, version, suite, config, trials, arguments.workers)
    except KeyboardInterrupt:
        status = INTERRUPTED
        print("stopped; the same command continues", file=sys.stderr)
    counted = _open(arguments)
    tallies = {version: counted.tally(version, suite) for version in versions}
    if arguments.json:
        print(json.dumps(_numbers(run, suite, tallies)))
    else:
        make_console().print(_table(run, suite, tallies))
    return status


def _open(arguments: argparse.Namespace) -> RunFolder:
    backend = [] if arguments.backend is None else [f"simulator.backend={arguments.backend}"]
    return RunFolder.open(arguments.run_folder, [*arguments.overrides, *backend])


@contextmanager
def _no_evaluator(folder: Path) -> Iterator[None]:
    """Be the only one that counts trials of a run, until the context ends."""
    try:
        with single_process(folder, Role.EVALUATOR, None):
            yield
    except AlreadyWorksError as error:
        raise UserError(
            f"the evaluator of the run in {folder} is at work; stop the run, then try again"
        ) from error


def _play(
    run: RunFolder, version: int, suite: Suite, config: Config, trials: int, workers: int
) -> None:
    with progress_bar(f"policy {version}", trials) as advance:
        play_missing_trials(
            trial_log_file(run.folder),
            run.policy(version),
            config,
            trials,
            suite.test_seeds.start,
            workers=workers,
            on_trial=advance,
            suite=suite,
        )


def _numbers(run: RunFolder, suite: Suite, tallies: dict[int, Tally]) -> dict[str, object]:
    return {
        "run": str(run.folder),
        "suite": suite.name,
        "versions": [{"version": each, **tally.as_json()} for each, tally in tallies.items()],
    }


def _table(run: RunFolder, suite: Suite, tallies: dict[int, Tally]) -> Table:
    table = Table(
        title=f"{run.folder}, suite {suite.name}", caption="% of the trials with the 95 % interval"
    )
    for heading in ("version", "trials", *READINGS):
        table.add_column(heading, justify="right", no_wrap=True)
    for version, tally in tallies.items():
        rates = (rate_text(tally.rate(reading), digits=0) for reading in READINGS)
        table.add_row(str(version), str(tally.trials), *rates)
    return table
