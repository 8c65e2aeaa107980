"""Jobs and result of testing a policy in situations that were not tutored."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from actors.tasks.registry import make_task
from proto.config import Config
from proto.episode import Kind
from proto.variables import Situation
from services.playing.workers import Job
from services.trials.success import Tally


def trial_jobs(config: Config, trials: int, seed: int, folder: Path | None = None) -> list[Job]:
    """Make the jobs of trials in random situations, which are the same for every policy.

    Args:
        config: the configuration, which names the task.
        trials: number of trials.
        seed: trial i plays the situation that the task samples with seed + i.
        folder: folder in which rollouts are recorded, or None.
    """
    task = make_task(config.task)
    return situation_jobs([task.sample(seed + trial) for trial in range(trials)], seed, folder)


def situation_jobs(
    situations: Sequence[Situation], seed: int, folder: Path | None = None
) -> list[Job]:
    """Make the jobs of trials in given situations; trial i has the seed `seed` + i."""
    return [
        Job(
            situation=situation,
            seed=seed + trial,
            kind=Kind.TRIAL,
            record_to=None if folder is None else folder / f"trial{trial:04d}.mcap",
        )
        for trial, situation in enumerate(situations)
    ]


def result_json(config: Config, policy: str, tally: Tally, wall_s: float) -> dict[str, Any]:
    """Return the result of an evaluation, for `json.dumps`."""
    return {
        "policy": policy,
        "task": config.task.name,
        "backend": config.simulator.backend,
        **tally.as_json(),
        "wall_s": wall_s,
    }
