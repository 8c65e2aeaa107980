"""Jobs and result of testing a policy in situations that were not tutored."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from actors.tasks.registry import make_task
from proto.config import Config
from proto.episode import Kind
from proto.situations import situation_of
from proto.suites import Suite
from proto.variables import Situation
from services.playing.workers import Job
from services.trials.success import Tally


def in_world_of(suite: Suite, config: Config) -> Config:
    """Return the configuration with the simulator in which a suite is played."""
    simulator = config.simulator.model_copy(update={"backend": suite.backend})
    return config.model_copy(update={"simulator": simulator})


def trial_jobs(
    config: Config,
    trials: int,
    seed: int,
    folder: Path | None = None,
    suite: Suite | None = None,
) -> list[Job]:
    """Make the jobs of trials in random situations, which are the same for every policy.

    Args:
        config: the configuration, which names the task.
        trials: number of trials.
        seed: trial i plays the situation that the task samples with seed + i.
        folder: folder in which rollouts are recorded, or None.
        suite: the suite whose conditions the trials have; None for no disturbances.

    Raises:
        UserError: the task cannot be played under these conditions.
    """
    task = make_task(config.task)
    situations = [
        situation_of(task, None if suite is None else suite.conditions(number), number)
        for number in range(seed, seed + trials)
    ]
    return situation_jobs(situations, seed, folder, suite)


def situation_jobs(
    situations: Sequence[Situation],
    seed: int,
    folder: Path | None = None,
    suite: Suite | None = None,
) -> list[Job]:
    """Make the jobs of trials in given situations; trial i has the seed `seed` + i."""
    return [
        Job(
            situation=situation,
            seed=seed + trial,
            kind=Kind.TRIAL,
            record_to=None if folder is None else folder / f"trial{trial:04d}.mcap",
            conditions=None if suite is None else suite.conditions(seed + trial),
        )
        for trial, situation in enumerate(situations)
    ]


def result_json(
    config: Config, policy: str, tally: Tally, wall_s: float, suite: Suite | None = None
) -> dict[str, Any]:
    """Return the result of an evaluation, for `json.dumps`; with the suite if there is one."""
    return {
        "policy": policy,
        "task": config.task.name,
        "backend": config.simulator.backend,
        **({} if suite is None else {"suite": suite.name}),
        **tally.as_json(),
        "wall_s": wall_s,
    }
