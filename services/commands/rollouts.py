"""`vmdnn rollouts`: the recorded rollouts of a run, to find those that one wants to look at."""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from itertools import chain, starmap
from pathlib import Path
from typing import Any

from proto.episode import NO_FAILURE, Kind
from proto.errors import UserError
from proto.plain_text import plain
from proto.recordings.episodes import EpisodeHeading, read_heading
from proto.variables import situation_text
from services.arguments.common import positive
from services.terminal.console import make_console
from services.terminal.run_words import outcome_words


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="folder of a run, or of files")
    parser.add_argument(
        "--failed", action="store_true", help="only rollouts that were not a precise success"
    )
    parser.add_argument("--reason", help="only rollouts with this outcome, such as not_lifted")
    parser.add_argument(
        "--kind",
        choices=[kind.value for kind in Kind],
        help="only rollouts that were played for this reason",
    )
    parser.add_argument("--policy-version", type=positive, help="only rollouts of this version")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(arguments: argparse.Namespace) -> int:
    """List the rollouts in the order in which they were played."""
    folder = arguments.run_folder / "rollouts"
    folder = folder if folder.is_dir() else arguments.run_folder
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}; `vmdnn runs` lists the runs")
    files = sorted(folder.glob("*.mcap"))
    if not files:
        raise UserError(f"{folder} holds no recording (*.mcap)")
    console = make_console(stderr=True)
    found: list[tuple[Path, EpisodeHeading]] = []
    outcomes: Counter[str] = Counter()
    for file in files:
        try:
            head = read_heading(file)
        except UserError as error:
            console.print(plain(f"left out: {error}"), soft_wrap=True)
            continue
        outcomes[outcome_words(head.outcome.reason)] += 1
        if _is_wanted(head, arguments):
            found.append((file, head))
    if not found and outcomes:
        there_are = ", ".join(f"{words} {count}" for words, count in outcomes.most_common())
        console.print(plain(f"no recording fits; there are: {there_are}", 500), soft_wrap=True)
    found.sort(key=lambda each: each[1].started_s or 0.0)
    if arguments.json:
        print(json.dumps([_numbers(*each) for each in found], indent=2))
    else:
        for line in chain.from_iterable(starmap(_lines, found)):
            print(plain(line))
    return 0


def _is_wanted(head: EpisodeHeading, arguments: argparse.Namespace) -> bool:
    return (
        (not arguments.failed or head.outcome.reason != NO_FAILURE)
        and arguments.reason in (None, head.outcome.reason, outcome_words(head.outcome.reason))
        and arguments.kind in (None, head.kind.value)
        and arguments.policy_version in (None, head.policy_version)
    )


def _numbers(file: Path, head: EpisodeHeading) -> dict[str, Any]:
    return {"file": str(file), **asdict(head), "reason": head.outcome.reason}


def _lines(file: Path, head: EpisodeHeading) -> Iterator[str]:
    """Yield what a rollout was, its situation, and its file, ready to be copied."""
    played = "time unknown       "
    if head.started_s is not None:
        played = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(head.started_s))
    policy = f"policy {head.policy_version}" if head.policy_version else head.policy
    yield f"{played}  {head.kind} of {policy}: {outcome_words(head.outcome.reason)}"
    yield f"    {situation_text(head.situation)}"
    yield f"    {file}"
