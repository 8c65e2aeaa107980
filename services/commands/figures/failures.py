"""`vmdnn figure failures`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from actors.tasks.registry import make_task
from proto.errors import UserError
from proto.recordings.episodes import read_episode
from services.arguments.common import add_config, config_of, integer
from services.figures import failures
from services.figures.figure_result import FigureResult
from services.trials.trial_log import CountedTrial, read_trials

NEWEST: Final = "newest"
SUMMARY: Final = "situations in which a policy fails, and its errors at the grasp"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the figure's arguments."""
    add_config(parser)
    parser.add_argument(
        "--outcomes",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="file of `vmdnn evaluate --outcomes`, or evaluation/trials.jsonl of a run",
    )
    parser.add_argument(
        "--rollouts", type=Path, nargs="+", default=[], metavar="DIR", help="folders of rollouts"
    )
    parser.add_argument(
        "--policy-version", type=_version, default=NEWEST, help="version whose trials are drawn"
    )


def draw(arguments: argparse.Namespace) -> FigureResult:
    """Read the trials of one policy and draw the situations in which it failed."""
    counted = list(_counted_trials(arguments))
    version = arguments.policy_version
    if version == NEWEST:
        version = max((trial.policy_version for trial in counted), default=0)
    found = [trial for trial in counted if trial.policy_version == version]
    trials = failures.Trials.of(found, make_task(config_of(arguments).task))
    name, version = _only_policy(found)
    words = f"{name} version {version}" if version else name
    return FigureResult(
        failures.draw(trials, f"{words}: {len(found)} trials"),
        {"policy": name, "policy_version": version, **failures.numbers(trials)},
        failures.table(trials),
    )


def _counted_trials(arguments: argparse.Namespace) -> Iterator[CountedTrial]:
    if not arguments.outcomes and not arguments.rollouts:
        raise UserError("name files of outcomes with --outcomes, or folders with --rollouts")
    for path in arguments.outcomes:
        yield from read_trials(path)
    for folder in arguments.rollouts:
        for path in sorted(folder.glob("*.mcap")):
            episode = read_episode(path)
            yield CountedTrial.of(episode, run_id=episode.policy)


def _only_policy(trials: list[CountedTrial]) -> tuple[str, int]:
    policies = sorted({(trial.run_id, trial.policy_version) for trial in trials})
    if len(policies) > 1:
        names = ", ".join(f"{name} version {version}" for name, version in policies)
        raise UserError(f"these are trials of {names}; name files or folders of one training")
    return policies[0]


def _version(text: str) -> int | str:
    return text if text == NEWEST else integer(0)(text)
