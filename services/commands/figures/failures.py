"""`vmdnn figure failures`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from actors.tasks.registry import make_task
from proto.config import Config
from proto.errors import UserError
from proto.recordings.episodes import read_episode
from services.arguments.common import add_config, config_of, integer
from services.figures import failures
from services.figures.figure_result import FigureResult
from services.trials.run_folder import RunFolder
from services.trials.trial_log import CountedTrial, read_trials

NEWEST: Final = "newest"
SUMMARY: Final = "situations in which a policy fails, and its errors at the grasp"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the figure's arguments."""
    parser.add_argument(
        "run_folder",
        type=Path,
        nargs="?",
        metavar="RUN",
        help="folder of a run: its configuration, and its counted trials in its first suite",
    )
    add_config(parser)
    parser.add_argument(
        "--outcomes",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="file of `vmdnn evaluate --outcomes`",
    )
    parser.add_argument(
        "--rollouts", type=Path, nargs="+", default=[], metavar="DIR", help="folders of rollouts"
    )
    parser.add_argument(
        "--policy-version", type=_version, default=NEWEST, help="version whose trials are drawn"
    )


def draw(arguments: argparse.Namespace) -> FigureResult:
    """Read the trials of one policy and draw the situations in which it failed."""
    config, counted = _counted(arguments)
    version = arguments.policy_version
    if version == NEWEST:
        version = max((trial.policy_version for trial in counted), default=0)
    found = [trial for trial in counted if trial.policy_version == version]
    trials = failures.Trials.of(found, make_task(config.task))
    name, version = _only_policy(found)
    if arguments.run_folder is not None:
        name = config.run.name
    words = f"{name} version {version}" if version else name
    return FigureResult(
        failures.draw(trials, f"{words}: {len(found)} trials"),
        {"policy": name, "policy_version": version, **failures.numbers(trials)},
        failures.table(trials),
    )


def _counted(arguments: argparse.Namespace) -> tuple[Config, list[CountedTrial]]:
    """The configuration, and the trials of all policy versions."""
    if arguments.run_folder is None:
        return config_of(arguments), list(_counted_trials(arguments))
    if arguments.outcomes or arguments.rollouts or arguments.config is not None:
        raise UserError("name either the folder of a run, or --config, --outcomes and --rollouts")
    run = RunFolder.open(arguments.run_folder, arguments.overrides)
    suite = run.config.suites[0]
    return run.config, [trial for each in run.versions for trial in run.trials(each, suite)]


def _counted_trials(arguments: argparse.Namespace) -> Iterator[CountedTrial]:
    if not arguments.outcomes and not arguments.rollouts:
        raise UserError(
            "name the folder of a run, files of outcomes with --outcomes, or folders with"
            " --rollouts"
        )
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
