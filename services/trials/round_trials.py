"""Trials of the policies that a run had at the end of each round.

Round 0 is coupled training before any corrections. Counted trials are kept in the run's folder and
are not played again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from learner.checkpoint import load_checkpoint
from learner.training.schedule import RoundSchedule
from proto.config import Config, load_config
from proto.episode import Outcome
from proto.errors import UserError
from proto.metrics import Stage
from services.trials.trial_playing import LoggedPolicy, play_missing_trials


@dataclass(frozen=True)
class RoundPolicy:
    """The policy at the end of a round.

    Attributes:
        round: number of the round.
        version: version of the policy.
        cases: number of different situations that it learned from.
        sequences: number of sequences that it learned from.
        file: its checkpoint.
    """

    round: int
    version: int
    cases: int
    sequences: int
    file: Path

    @property
    def digest(self) -> str:
        """Distinguishes it from a policy of this version in a run that was started anew."""
        return hashlib.sha256(self.file.read_bytes()).hexdigest()[:16]


@dataclass(frozen=True)
class Run:
    """A run in which at least round 0 is done.

    Attributes:
        folder: its folder.
        config: its config.
        policies: the policy at the end of each round that is done, in order.
    """

    folder: Path
    config: Config
    policies: Sequence[RoundPolicy]


def open_run(folder: Path) -> Run:
    """Find the policies of a run.

    Raises:
        UserError: it is not the folder of a run, or round 0 is not done.
    """
    config = load_config(folder / "config.yaml")
    corrections = config.learner.corrections
    schedule = RoundSchedule(config.learner.epochs, corrections.rounds, corrections.epochs)
    rounds = {schedule.end_of(number): number for number in range(corrections.rounds + 1)}
    policies = []
    for file in sorted((folder / "policies").glob("*.safetensors")):
        metadata = load_checkpoint(file).metadata
        if metadata.stage is Stage.COUPLED and metadata.epoch in rounds and metadata.cases:
            policies.append(
                RoundPolicy(
                    rounds[metadata.epoch],
                    metadata.version,
                    metadata.cases,
                    metadata.sequences,
                    file,
                )
            )
    if not policies:
        raise UserError(
            f"{folder} has no policy that was published at epoch {config.learner.epochs}, the end"
            " of coupled training before any corrections; let the run go on to there"
        )
    return Run(folder, config, policies)


def play_trials(
    run: Run,
    policy: RoundPolicy,
    trials: int,
    seed: int,
    *,
    workers: int,
    on_trial: Callable[[], None],
) -> list[Outcome]:
    """Play the trials of a policy that were not counted yet; the outcomes of all of them.

    Args:
        run: the run.
        policy: one of its policies.
        trials: number of trials; the situations are the same for every policy.
        seed: seed of the first.
        workers: processes to play in.
        on_trial: called for each trial, also for those counted before.
    """
    return play_missing_trials(
        run.folder / "evaluation" / "round_trials.jsonl",
        LoggedPolicy(policy.file, policy.digest, policy.version),
        run.config,
        trials,
        seed,
        workers=workers,
        on_trial=on_trial,
    )
