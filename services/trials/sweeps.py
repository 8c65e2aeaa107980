"""Training and testing of many networks: variants of a configuration, each with several seeds.

Each network has a folder of its own, as a run has: config, checkpoints, policies and the trials
that were counted. What is there is not done again, so a sweep goes on where it was stopped.
"""

from __future__ import annotations

import operator
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Self

from pydantic import ValidationError

from actors.tasks.registry import make_pretraining_task
from learner.checkpoint import load_checkpoint, policy_file, training_file
from learner.rivals.networks import rival_config
from learner.rivals.training import train_rival
from learner.training.training_run import open_training, run_training
from learner.tutoring.store import TutoringStore
from proto.config import Config, RivalKind, load_config
from proto.episode import Outcome
from proto.errors import UserError
from proto.messages import Rollout
from proto.metrics import Stage
from proto.storage import written_whole
from services.playing.workers import play_all
from services.trials.evaluation import trial_jobs
from services.trials.trial_log import TrialLog


@dataclass(frozen=True)
class Variant:
    """What some networks of a sweep have in common.

    Attributes:
        name: what its networks are called, and the beginning of the names of their folders.
        config: what their training depends on, besides the seed.
        rival: which kind of network is trained in VMDNN's place, or None.
    """

    name: str
    config: Config
    rival: RivalKind | None = None

    @classmethod
    def of(cls, name: str, config: Config, changes: Mapping[str, object]) -> Self:
        """A config in which some values, named as in `network.pfc.tau`, are others.

        Raises:
            UserError: one of them is not valid.
        """
        values = config.model_dump()
        for key, value in changes.items():
            *sections, last = key.split(".")
            reduce(operator.getitem, sections, values)[last] = value
        try:
            return cls(name, Config.model_validate(values))
        except ValidationError as error:
            raise UserError(f"{name}: {error.errors()[0]['msg']}") from error


@dataclass(frozen=True)
class Member:
    """One network of a sweep.

    Attributes:
        variant: what it is one of.
        seed: seed of its weights and of the order of its training.
        config: everything its training depends on; its run folder is the network's own.
    """

    variant: Variant
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


def members_of(variants: Sequence[Variant], seeds: Sequence[int], folder: Path) -> list[Member]:
    """A network for each variant and seed; all variants of the first seed first.

    Raises:
        UserError: one of the folders holds a network of another config.
    """
    members = [_member(variant, seed, folder) for seed in seeds for variant in variants]
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
        pretraining_store: sequences for its pre-training, if others; a rival has no use for them.
        go_on: called with the loss after each epoch; False stops the training.
    """
    config, folder, rival = member.config, member.folder, member.variant.rival
    before, started = training_s(member), time.process_time()
    try:
        if rival is not None:
            return train_rival(config, rival, folder, store, go_on)
        trainer = open_training(
            config,
            folder,
            store,
            pretraining_store,
            questions=make_pretraining_task(config).questions,
        )
        run_training(trainer, config.learner, folder, go_on)
        return trainer.finished
    finally:
        _note_training_s(member, before + time.process_time() - started)


def training_s(member: Member) -> float:
    """Processor time that its training has taken so far (s); what a kill cut off is not in it."""
    path = _time_file(member)
    return float(path.read_text()) if path.exists() else 0.0


def epochs_of(member: Member) -> int:
    """Epochs of a whole training."""
    return sum(_epochs(member))


def epochs_done(member: Member) -> int:
    """Epochs of its training that are behind it."""
    path = training_file(member.folder)
    if not path.exists():
        return 0
    metadata = load_checkpoint(path).metadata
    first, _ = _epochs(member)
    return metadata.epoch + (0 if metadata.stage is Stage.PRETRAINING else first)


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
    book = TrialLog(member.folder / "trials.jsonl")
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


def _member(variant: Variant, seed: int, folder: Path) -> Member:
    named = {"run.name": f"{variant.name}_seed{seed}", "run.folder": folder, "run.seed": seed}
    return Member(variant, seed, Variant.of(f"seed {seed}", variant.config, named).config)


def _epochs(member: Member) -> tuple[int, int]:
    """Epochs of the two stages of its training."""
    learner, rival = member.config.learner, member.variant.rival
    if rival is None:
        return learner.pretraining.epochs, learner.epochs
    settings = rival_config(member.config.comparison, rival)
    return settings.together_epochs, settings.epochs


def _time_file(member: Member) -> Path:
    return member.folder / "training_s.txt"


def _note_training_s(member: Member, seconds: float) -> None:
    with written_whole(_time_file(member)) as stream:
        stream.write(f"{seconds:.1f}\n".encode())


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
