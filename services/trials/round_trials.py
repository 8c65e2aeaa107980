"""Trials of the policies that a run had at the end of its laps, so of every round of corrections.

What was counted lies in the run's folder and is not played again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from learner.checkpoint import load_checkpoint
from learner.training.schedule import Laps
from proto.config import Config, load_config
from proto.episode import Outcome
from proto.errors import UserError
from proto.messages import Rollout
from proto.metrics import Stage
from services.playing.workers import play_all
from services.trials.evaluation import trial_jobs
from services.trials.trial_log import TrialLog


@dataclass(frozen=True)
class LapEnd:
    """The policy at the end of a lap.

    Attributes:
        round: round of corrections that it learned from last, 0 for none.
        version: its version.
        cases: different situations that it learned from.
        sequences: sequences that it learned from.
        file: where it is.
    """

    round: int
    version: int
    cases: int
    sequences: int
    file: Path

    @property
    def digest(self) -> str:
        """Tells it from the policy of this version in a run that was started anew."""
        return hashlib.sha256(self.file.read_bytes()).hexdigest()[:16]


@dataclass(frozen=True)
class Run:
    """A run that is over, or far enough.

    Attributes:
        folder: where it is.
        config: its configuration.
        lap_ends: its policies at the end of each lap that is done, in this order.
    """

    folder: Path
    config: Config
    lap_ends: Sequence[LapEnd]


def open_run(folder: Path) -> Run:
    """Find the policies of a run.

    Raises:
        UserError: it is no folder of a run, or no lap of it is done.
    """
    config = load_config(folder / "config.yaml")
    corrections = config.learner.corrections
    laps = Laps(config.learner.epochs, corrections.rounds, corrections.epochs)
    rounds = {laps.end_of(number): number for number in range(corrections.rounds + 1)}
    lap_ends = []
    for file in sorted((folder / "policies").glob("*.safetensors")):
        metadata = load_checkpoint(file).metadata
        if metadata.stage is Stage.COUPLED and metadata.epoch in rounds and metadata.cases:
            lap_ends.append(
                LapEnd(
                    rounds[metadata.epoch],
                    metadata.version,
                    metadata.cases,
                    metadata.sequences,
                    file,
                )
            )
    if not lap_ends:
        raise UserError(
            f"{folder} has no policy that was published at epoch {config.learner.epochs}, the end"
            " of its first lap; let the run go on to there"
        )
    return Run(folder, config, lap_ends)


def test(
    run: Run,
    lap_end: LapEnd,
    trials: int,
    seed: int,
    *,
    workers: int,
    on_trial: Callable[[], None],
) -> list[Outcome]:
    """Play those of the trials of a policy that were not counted yet; the outcomes of all.

    Args:
        run: the run.
        lap_end: one of its policies.
        trials: how many; the same situations for every policy.
        seed: seed of the first.
        workers: processes to play in.
        on_trial: called for each trial, also for those counted before.
    """
    book = TrialLog(run.folder / "evaluation" / "lap_trials.jsonl")
    policy = lap_end.digest, lap_end.version
    counted = book.outcomes(*policy)
    jobs = trial_jobs(run.config, trials, seed)
    missing = [job for job in jobs if job.seed not in counted]
    for _ in range(len(jobs) - len(missing)):
        on_trial()
    with closing(play_all(run.config, str(lap_end.file), missing, workers=workers)) as played:
        for _, episode in played:
            book.add(Rollout(episode, lap_end.digest))
            on_trial()
    counted = book.outcomes(*policy)
    return [counted[job.seed] for job in jobs]
