"""`vmdnn figure activity`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from actors.policies.by_name import make_policy
from actors.policies.contract import StatefulPolicy
from actors.tasks.registry import make_task
from proto.errors import UserError
from proto.recordings.episodes import read_episode
from services.arguments.common import add_config, config_of
from services.figures import activity
from services.figures.figure_result import FigureResult

SUMMARY: Final = "units and outputs of the network over time (paper, figure 4)"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the figure's arguments."""
    add_config(parser)
    parser.add_argument(
        "--rollouts", type=Path, nargs="+", required=True, metavar="MCAP", help="recorded rollouts"
    )
    parser.add_argument(
        "--policy", help="checkpoint that played the rollouts; needed if they have no states"
    )


def draw(arguments: argparse.Namespace) -> FigureResult:
    """Read the rollouts and draw them side by side."""
    policy = None if arguments.policy is None else _stateful_policy(arguments)
    episodes = [read_episode(path) for path in arguments.rollouts]
    activities = [activity.activity_of(episode, policy) for episode in episodes]
    return FigureResult(
        activity.draw(activities), activity.numbers(activities), activity.table(activities)
    )


def _stateful_policy(arguments: argparse.Namespace) -> StatefulPolicy:
    policy = make_policy(arguments.policy, make_task(config_of(arguments).task))
    if not isinstance(policy, StatefulPolicy):
        raise UserError(f"--policy {arguments.policy} has no states; name a network's checkpoint")
    return policy
