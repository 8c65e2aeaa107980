"""`vmdnn compare-trials`: two policies, or one in two simulators, in the same situations."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from rich.console import JustifyMethod
from rich.table import Table

from services.terminal.console import make_console
from services.terminal.rates import rate_text
from services.trials.paired import PairedTrials, pair_trials
from services.trials.success import READINGS
from services.trials.trial_log import read_trials


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    what = "outcomes that `vmdnn evaluate --outcomes FILE` wrote, or the trial log of a run"
    parser.add_argument("first", type=Path, help=what)
    parser.add_argument("second", type=Path, help="outcomes of the same situations")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(arguments: argparse.Namespace) -> int:
    """Print both success rates, how often only one succeeded, and McNemar's test."""
    paired = pair_trials(read_trials(arguments.first), read_trials(arguments.second))
    if arguments.json:
        print(json.dumps(paired.as_json()))
    else:
        make_console().print(_table(paired, arguments.first.name, arguments.second.name))
    return 0


def _table(paired: PairedTrials, first: str, second: str) -> Table:
    table = Table(
        title=f"{len(paired.pairs)} trials: {first} and {second}",
        caption=_caption(paired),
    )
    for heading in ("reading", "policy", "success % (95 %)", "succeeds alone", "p"):
        justify: JustifyMethod = "left" if heading in ("reading", "policy") else "right"
        table.add_column(heading, justify=justify, no_wrap=True)
    for reading in READINGS:
        counts = paired.counts(reading)
        ours, theirs = rate_text(counts.first), rate_text(counts.second)
        table.add_row(reading, "first", ours, str(counts.only_first), f"{counts.p_value:.2g}")
        table.add_row("", "second", theirs, str(counts.only_second))
        table.add_section()
    return table


def _caption(paired: PairedTrials) -> str:
    caption = "p is that of McNemar's exact, two-sided test: small if one of the two is better"
    if paired.only_in_first or paired.only_in_second:
        caption += (
            f"; without a partner: {paired.only_in_first} trials of the first,"
            f" {paired.only_in_second} of the second"
        )
    return caption
