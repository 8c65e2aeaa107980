"""Training and testing of many networks that differ in one setting and in their seed.

Each network has a folder of its own, as a run has: config, checkpoints, policies and the trials
that were counted. What is there is not done again, so a sweep goes on where it was stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from learner.checkpoint import load_checkpoint, policy_file, training_file
from learner.offline import open_training, run_training
from learner.store import TutoringStore
from proto.config import Config, load_config
from proto.episode import Outcome
from proto.errors import UserError
from proto.messages import Rollout
from proto.metrics import Stage
from services.evaluation import trial_jobs
from services.playing import play_all
from services.trial_book import TrialBook


@dataclass(frozen=True)
class Member:
    """One network of a sweep.

    Attributes:
        tau: time constant of its PFC.
        seed: seed of its weights and of the order of its training.
        config: everything its training depends on; its run folder is the network's own.
    """

    tau: float
    seed: int
    config: Config

    @property
    def folder(self) -> Path:
        """Folder of the network."""
        return self.config.run_folder


@dataclass(frozen=True)
class Tested:
    """A network that was trained, and the outcomes of its trials."""

    member: Member
    outcomes: Sequence[Outcome]


def members_of(
    config: Config, taus: Sequence[float], seeds: Sequence[int], folder: Path
) -> list[Member]:
    """A network for each time constant and seed; all time constants of the first seed first.

    Raises:
        UserError: one of the folders holds a network of another config.
    """
    members = [
        Member(tau, seed, _config(config, tau, seed, folder)) for seed in seeds for tau in taus
    ]
    for member in members:
        _claim(member)
    return members


def train(
    member: Member,
    store: TutoringStore,
    pretraining_store: TutoringStore | None,
    go_on: Callable[[float], bool],
) -> bool:
    """Train a network from its random weights on, or go on with it; whether it is finished.

    Nothing is shared with other networks, also not the pre-trained vision: the PFC takes part in
    pre-training, so its time constant makes a difference there too.

    Args:
        member: the network.
        store: its tutored sequences.
        pretraining_store: sequences for its pre-training, if others.
        go_on: called with the loss after each epoch; False stops the training.
    """
    trainer = open_training(member.config, member.folder, store, pretraining_store)
    run_training(trainer, member.config.learner, member.folder, go_on)
    return trainer.finished


def epochs_of(member: Member) -> int:
    """Epochs of a whole training."""
    learner = member.config.learner
    return learner.pretraining.epochs + learner.epochs


def epochs_done(member: Member) -> int:
    """Epochs of its training that are behind it."""
    path = training_file(member.folder)
    if not path.exists():
        return 0
    metadata = load_checkpoint(path).metadata
    before = 0 if metadata.stage is Stage.PRETRAINING else member.config.learner.pretraining.epochs
    return before + metadata.epoch


def test(
    member: Member, trials: int, seed: int, *, workers: int, on_trial: Callable[[], None]
) -> Tested:
    """Play those of the trials of a trained network that were not counted yet.

    Args:
        member: the network.
        trials: how many; the same situations for every network.
        seed: seed of the first.
        workers: processes to play in.
        on_trial: called for each trial, also for those counted before.
    """
    version = load_checkpoint(training_file(member.folder)).metadata.version
    run_id = member.config.run.name
    book = TrialBook(member.folder / "trials.jsonl")
    counted = book.outcomes(run_id, version)
    jobs = trial_jobs(member.config, trials, seed)
    missing = [job for job in jobs if job.seed not in counted]
    for _ in range(len(jobs) - len(missing)):
        on_trial()
    policy = str(policy_file(member.folder, version))
    with closing(play_all(member.config, policy, missing, workers=workers)) as played:
        for _, episode in played:
            book.add(Rollout(episode, run_id))
            on_trial()
    counted = book.outcomes(run_id, version)
    return Tested(member, [counted[job.seed] for job in jobs])


def _config(config: Config, tau: float, seed: int, folder: Path) -> Config:
    network = config.network.model_copy(
        update={"pfc": config.network.pfc.model_copy(update={"tau": tau})}
    )
    run = config.run.model_copy(
        update={"name": f"tau{tau:g}_seed{seed}", "folder": folder, "seed": seed}
    )
    changed = config.model_copy(update={"network": network, "run": run})
    try:
        return Config.model_validate(changed.model_dump())  # model_copy checks nothing
    except ValidationError as error:
        raise UserError(f"tau {tau:g}, seed {seed}: {error.errors()[0]['msg']}") from error


def _claim(member: Member) -> None:
    """Save the configuration before the first epoch, and keep to it ever after."""
    saved = member.folder / "config.yaml"
    if not saved.exists():
        member.config.save(saved)
    elif load_config(saved).digest() != member.config.digest():
        raise UserError(
            f"{member.folder} holds a network of another config, see {saved}; take another folder"
            " with --work, or the config from before"
        )
