"""Testing a policy on situations that were never tutored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from actors.tasks.registry import make_task
from proto.config import Config
from proto.episode import Kind
from services.playing import Job
from services.success import Tally


def trial_jobs(config: Config, trials: int, seed: int, folder: Path | None = None) -> list[Job]:
    """Trials 0, 1, ... of a seed: the same situations for every policy and backend.

    Args:
        config: names the task.
        trials: how many.
        seed: trial i plays the situation that the task samples with seed + i.
        folder: where rollouts are recorded, or None.
    """
    task = make_task(config.task)
    return [
        Job(
            situation=task.sample(seed + trial),
            seed=seed + trial,
            kind=Kind.TRIAL,
            record_to=None if folder is None else folder / f"trial{trial:04d}.mcap",
        )
        for trial in range(trials)
    ]


def result_json(config: Config, policy: str, tally: Tally, wall_s: float) -> dict[str, Any]:
    """What an evaluation found, for `json.dumps`."""
    return {
        "policy": policy,
        "task": config.task.name,
        "backend": config.simulator.backend,
        **tally.as_json(),
        "wall_s": wall_s,
    }
