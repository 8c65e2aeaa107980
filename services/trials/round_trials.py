"""Trials of the policies that a run had at the end of each round.

Round 0 is coupled training before any corrections. Counted trials are kept in the run's folder and
are not played again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from learner.checkpoint import load_checkpoint
from learner.training.schedule import RoundSchedule
from proto.config import Config, load_config
from proto.errors import UserError
from proto.metrics import Stage
from services.trials.trial_playing import LoggedPolicy


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

    def logged(self) -> LoggedPolicy:
        """The policy as the trial log names it.

        A digest of the file stands for the training, so that trials of a run that was started anew
        are counted separately.
        """
        digest = hashlib.sha256(self.file.read_bytes()).hexdigest()[:16]
        return LoggedPolicy(self.file, digest, self.version)


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

    @property
    def trial_log(self) -> Path:
        """File of the counted trials."""
        return self.folder / "evaluation" / "round_trials.jsonl"


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
            " of coupled training before any corrections; continue the run until then"
        )
    return Run(folder, config, policies)
