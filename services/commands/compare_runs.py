"""`vmdnn compare-runs`: what differs in the configurations of two runs, and in their success."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.table import Table

from proto.errors import UserError
from proto.suites import Suite
from services.terminal.console import make_console
from services.terminal.rates import rate_text
from services.trials.paired import PairedTrials, pair_trials
from services.trials.run_folder import RunFolder
from services.trials.success import READINGS, Tally
from services.trials.trial_log import CountedTrial

Difference = tuple[str, Any, Any]
"""Key, value in the first run, value in the second."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("first", type=Path, help="folder of a run")
    parser.add_argument("second", type=Path, help="folder of another run")
    parser.add_argument("--suite", help="suite to compare; without it, the first of both")
    parser.add_argument(
        "--policy-version",
        default="best",
        metavar="best|newest|N",
        help="which version of each run is compared",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")


def run(arguments: argparse.Namespace) -> int:
    """Print the differences."""
    runs = [RunFolder.open(folder) for folder in (arguments.first, arguments.second)]
    suites = [_suite(run, arguments.suite) for run in runs]
    versions = [
        _version(run, arguments.policy_version, suite)
        for run, suite in zip(runs, suites, strict=True)
    ]
    trials = [
        run.trials(version, suite)
        for run, version, suite in zip(runs, versions, suites, strict=True)
    ]
    tallies = [
        run.tally(version, suite)
        for run, version, suite in zip(runs, versions, suites, strict=True)
    ]
    first, second = (run.config.model_dump(mode="json") for run in runs)
    differences = list(_differences(first, second))
    paired = _paired(*trials)
    if arguments.json:
        print(json.dumps(_numbers(runs, versions, tallies, differences, paired)))
        return 0
    console = make_console()
    console.print(_config_table(differences))
    console.print(_success_table(runs, versions, tallies, paired))
    return 0


def _suite(run: RunFolder, name: str | None) -> Suite:
    return run.config.suites[0] if name is None else run.config.suite(name)


def _version(run: RunFolder, words: str, suite: Suite) -> int:
    if words == "all":
        raise UserError("--policy-version all: one version of each run is compared; name it")
    return run.chosen_versions(words, suite)[0]


def _differences(
    first: Mapping[str, Any], second: Mapping[str, Any], prefix: str = ""
) -> Iterator[Difference]:
    """Yield the keys with different values, except name and folder of the run and the hub."""
    for name in {**first, **second}:
        key = f"{prefix}{name}"
        ours, theirs = first.get(name), second.get(name)
        if ours == theirs or key in ("run.name", "run.folder", "hub"):
            continue
        if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
            yield from _differences(ours, theirs, f"{key}.")
        else:
            yield key, ours, theirs


def _paired(first: list[CountedTrial], second: list[CountedTrial]) -> PairedTrials | None:
    """Pair the trials of the same situations; None if there are none."""
    try:
        return pair_trials(first, second)
    except UserError:
        return None


def _numbers(
    runs: list[RunFolder],
    versions: list[int],
    tallies: list[Tally],
    differences: list[Difference],
    paired: PairedTrials | None,
) -> dict[str, Any]:
    return {
        "runs": [str(run.folder) for run in runs],
        "versions": versions,
        "config": [{"key": k, "first": one, "second": two} for k, one, two in differences],
        "success": [tally.as_json() for tally in tallies],
        "paired": None if paired is None else paired.as_json(),
    }


def _config_table(differences: list[Difference]) -> Table:
    table = Table(title="configuration" if differences else "the configurations are the same")
    for heading in ("key", "first", "second"):
        table.add_column(heading, overflow="fold")
    for key, first, second in differences:
        table.add_row(key, json.dumps(first), json.dumps(second))
    return table


def _success_table(
    runs: list[RunFolder], versions: list[int], tallies: list[Tally], paired: PairedTrials | None
) -> Table:
    """Success of both, and McNemar's test if they were tried in the same situations."""
    caption = "% of the trials with the 95 % interval"
    if paired is None:
        caption += "; no situation was tried in both runs, so they are not paired"
    else:
        caption += (
            f"; alone: in how many of {len(paired.pairs)} situations that both were tried in only"
            " the first and only the second succeeded; p: McNemar's exact test"
        )
    named = " and ".join(
        f"{run.folder} version {version}" for run, version in zip(runs, versions, strict=True)
    )
    table = Table(title=named, caption=caption)
    table.add_column("reading")
    tested_headings = ("alone", "p") if paired is not None else ()
    for heading in ("first", "second", *tested_headings):
        table.add_column(heading, justify="right")
    for reading in READINGS:
        rates = [rate_text(tally.rate(reading)) for tally in tallies]
        tested: tuple[str, ...] = ()
        if paired is not None:
            counts = paired.counts(reading)
            alone = f"{counts.only_first} / {counts.only_second}"
            tested = (alone, f"{counts.p_value:.2g}")
        table.add_row(reading, *rates, *tested)
    table.add_row("trials", *(str(tally.trials) for tally in tallies))
    return table
