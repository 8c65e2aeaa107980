"""`vmdnn figure memory`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from actors.policies.by_name import check_task
from actors.tasks.registry import make_task
from learner.checkpoint import load_checkpoint
from learner.network_policy import NetworkPolicy
from proto.recordings.episodes import read_episode
from services.arguments.common import add_config, config_of, positive
from services.figures import memory
from services.figures.figure_result import FigureResult
from services.figures.memory import Cue, MemoryTask, Network, Recall
from services.terminal.progress import progress_bar

SUMMARY: Final = "how long networks hold what they saw, by the time constant of the PFC"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the figure's arguments."""
    add_config(parser)
    parser.add_argument(
        "--policies", nargs="+", required=True, metavar="CHECKPOINT", help="networks to test"
    )
    parser.add_argument(
        "--rollouts",
        type=Path,
        nargs="+",
        required=True,
        metavar="MCAP",
        help="recorded episodes of any policy; only their pictures are used",
    )
    parser.add_argument(
        "--steps", type=positive, default=200, help="number of steps with the last picture"
    )


def draw(arguments: argparse.Namespace) -> FigureResult:
    """Show the pictures of the rollouts to the networks and draw what their outputs tell."""
    episodes = [read_episode(path) for path in arguments.rollouts]
    task = MemoryTask.of(make_task(config_of(arguments).task_called(episodes[0].task)))
    cues = [task.cue_of(episode) for episode in episodes]
    networks = [_network(file, task.name) for file in arguments.policies]
    retentions = memory.retentions_of(_recalls(task, networks, cues, arguments.steps))
    return FigureResult(
        memory.draw(task, retentions),
        memory.numbers(task, retentions),
        memory.table(task, retentions),
    )


def _network(file: str, task: str) -> Network:
    checkpoint, origin = load_checkpoint(file), f"checkpoint {file}"
    check_task(checkpoint, task, origin)
    return Network(NetworkPolicy(checkpoint, origin), file, checkpoint.metadata.network.pfc.tau)


def _recalls(
    task: MemoryTask, networks: list[Network], cues: list[Cue], steps: int
) -> list[Recall]:
    recalls = []
    with progress_bar("testing memory", len(networks)) as advance:
        for network in networks:
            recalls.append(memory.recall_of(task, network, cues, steps))
            advance()
    return recalls
