"""Arguments of the figures that show the activity of a network in recorded rollouts."""

from __future__ import annotations

import argparse
from collections.abc import Collection
from pathlib import Path

from actors.policies.by_name import make_policy
from actors.policies.contract import StatefulPolicy
from actors.tasks.registry import make_task
from proto.errors import UserError
from proto.recordings.episodes import read_episode
from services.arguments.common import add_config, config_of
from services.figures.rollouts import Activity, activity_of


def add_rollouts(parser: argparse.ArgumentParser) -> None:
    """Add --config, --set, --rollouts and --policy."""
    add_config(parser)
    parser.add_argument(
        "--rollouts", type=Path, nargs="+", required=True, metavar="MCAP", help="recorded rollouts"
    )
    parser.add_argument(
        "--policy", help="checkpoint that played the rollouts; needed if they have no states"
    )


def activities_of(arguments: argparse.Namespace, subnets: Collection[str]) -> list[Activity]:
    """Read rollouts with the activity of the network that played them.

    Args:
        arguments: the parsed arguments of `add_rollouts`.
        subnets: names of the subnets whose states are needed.

    Raises:
        UserError: a rollout cannot be read, or its states are not available.
    """
    episodes = [read_episode(path) for path in arguments.rollouts]
    policy = None if arguments.policy is None else _stateful_policy(arguments, episodes[0].task)
    return [activity_of(episode, policy, subnets) for episode in episodes]


def _stateful_policy(arguments: argparse.Namespace, task: str) -> StatefulPolicy:
    policy = make_policy(arguments.policy, make_task(config_of(arguments).task_called(task)))
    if not isinstance(policy, StatefulPolicy):
        raise UserError(f"--policy {arguments.policy} has no states; name a network's checkpoint")
    return policy
