"""Plays the trials of a policy that are not in its trial log yet."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from proto.config import Config
from proto.episode import Outcome
from proto.messages import Rollout
from proto.suites import UNLEARNED, Suite
from services.playing.workers import play_all
from services.trials.evaluation import trial_jobs
from services.trials.trial_log import TrialLog


@dataclass(frozen=True)
class LoggedPolicy:
    """A policy, and how a trial log names it.

    Attributes:
        file: its checkpoint.
        run_id: id of its training.
        version: its version in that training.
    """

    file: Path
    run_id: str
    version: int


def play_missing_trials(
    log_file: Path,
    policy: LoggedPolicy,
    config: Config,
    trials: int,
    seed: int,
    *,
    workers: int,
    on_trial: Callable[[], None],
    suite: Suite | None = None,
) -> list[Outcome]:
    """Play the trials of a policy that are not in its log; return the outcomes of all its trials.

    Args:
        log_file: the trial log; trials that are played are added to it.
        policy: the policy.
        config: the configuration, which names task and simulator.
        trials: number of trials.
        seed: seed of the first trial; the same seed gives every policy the same situations.
        workers: number of processes.
        on_trial: called for each trial, also for those in the log.
        suite: the suite whose conditions the trials have; None for no disturbances.

    Raises:
        UserError: see `play_all`.
    """
    log = TrialLog(log_file)
    name = UNLEARNED if suite is None else suite.name
    logged = log.outcomes(policy.run_id, policy.version, name)
    jobs = trial_jobs(config, trials, seed, suite=suite)
    missing = [job for job in jobs if job.seed not in logged]
    for _ in range(len(jobs) - len(missing)):
        on_trial()
    with closing(play_all(config, str(policy.file), missing, workers=workers)) as played:
        for _, episode in played:
            log.add(Rollout(episode, policy.run_id))
            on_trial()
    logged = log.outcomes(policy.run_id, policy.version, name)
    return [logged[job.seed] for job in jobs]
