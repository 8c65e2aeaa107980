"""Training and testing of many networks: variants of a config, each with several seeds.

Each network has a folder like that of a run: config, checkpoints, policies and counted trials.
Work that is done already is not repeated, so a stopped sweep can be continued.
"""

from __future__ import annotations

import operator
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Self

from pydantic import ValidationError

from actors.tasks.registry import make_pretraining_task, make_task
from learner.checkpoint import load_checkpoint, policy_file, training_file
from learner.rivals.rival_recipe import make_recipe
from learner.training.recipe import Recipe
from learner.training.training_run import open_training, run_training
from learner.tutoring.store import TutoringStore
from proto.config import Config, RivalKind, load_config
from proto.episode import Outcome
from proto.errors import UserError
from proto.metrics import Stage
from proto.run_locks import owned_training
from proto.storage import written_whole
from services.trials.trial_playing import LoggedPolicy, play_missing_trials


@dataclass(frozen=True)
class Variant:
    """What the runs of a sweep have in common that differ in their seed only.

    Attributes:
        name: name of the variant; the names of its runs begin with it.
        config: everything the training depends on, besides the seed.
        rival: kind of network that is trained in place of VMDNN, or None.
    """

    name: str
    config: Config
    rival: RivalKind | None = None

    @classmethod
    def of(cls, name: str, config: Config, changes: Mapping[str, object]) -> Self:
        """A variant with some values changed.

        Args:
            name: name of the variant.
            config: the config to change.
            changes: new values by name, such as `network.pfc.tau`.

        Raises:
            UserError: a value is not valid.
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
class SweepRun:
    """One training of a sweep.

    Attributes:
        variant: the variant that is trained.
        seed: seed of the weights and of the order of the training.
        config: everything the training depends on; its run folder belongs to this run alone.
    """

    variant: Variant
    seed: int
    config: Config

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self.config.run_folder

    def recipe(self) -> Recipe:
        """The network with random weights, and how it is trained."""
        questions = make_pretraining_task(self.config).questions
        distractors = make_task(self.config.task).distractors
        return make_recipe(self.config, self.variant.rival, questions, distractors)


@dataclass(frozen=True)
class RunOutcomes:
    """A trained network and the outcomes of its trials."""

    run: SweepRun
    outcomes: Sequence[Outcome]


def open_runs(variants: Sequence[Variant], seeds: Sequence[int], folder: Path) -> list[SweepRun]:
    """A run for each variant and seed, all variants of the first seed first.

    Raises:
        UserError: a run's folder holds a network of another config.
    """
    runs = [_run(variant, seed, folder) for seed in seeds for variant in variants]
    for run in runs:
        _save_config(run)
    return runs


def train(
    run: SweepRun,
    store: TutoringStore,
    pretraining_store: TutoringStore | None,
    go_on: Callable[[float], bool],
) -> bool:
    """Train a network from random weights, or continue its training; return whether it is done.

    Networks share nothing, not even the pre-trained vision: the PFC takes part in pre-training, so
    its time constant makes a difference there too.

    Args:
        run: the run.
        store: tutored sequences.
        pretraining_store: sequences for pre-training, or None for those of `store`. Rivals learn
            from those of `store` only.
        go_on: called with the loss after each epoch; False stops the training.
    """
    first_store = pretraining_store if run.variant.rival is None else None
    with owned_training(run.folder):
        before, started = training_s(run), time.process_time()
        try:
            trainer = open_training(run.recipe(), run.folder, store, first_store)
            run_training(trainer, run.folder, go_on)
            return trainer.finished
        finally:
            _save_training_s(run, before + time.process_time() - started)


def training_s(run: SweepRun) -> float:
    """Processor time of the training so far (s), without that lost when a process was killed."""
    path = _time_file(run)
    return float(path.read_text()) if path.exists() else 0.0


def epochs_total(run: SweepRun) -> int:
    """Epochs of the whole training."""
    recipe = run.recipe()
    return recipe.pretraining_epochs + recipe.coupled_epochs


def epochs_done(run: SweepRun) -> int:
    """Epochs of the training that are done."""
    path = training_file(run.folder)
    if not path.exists():
        return 0
    metadata = load_checkpoint(path).metadata
    before = 0 if metadata.stage is Stage.PRETRAINING else run.recipe().pretraining_epochs
    return before + metadata.epoch


def play_trials(
    run: SweepRun, trials: int, seed: int, *, workers: int, on_trial: Callable[[], None]
) -> RunOutcomes:
    """Play the trials of a trained network that were not counted yet.

    Args:
        run: the run.
        trials: number of trials; the situations are the same for every network.
        seed: seed of the first.
        workers: processes to play in.
        on_trial: called for each trial, also for those counted before.
    """
    version = load_checkpoint(training_file(run.folder)).metadata.version
    policy = LoggedPolicy(policy_file(run.folder, version), run.config.run.name, version)
    outcomes = play_missing_trials(
        run.folder / "trials.jsonl",
        policy,
        run.config,
        trials,
        seed,
        workers=workers,
        on_trial=on_trial,
    )
    return RunOutcomes(run, outcomes)


def _run(variant: Variant, seed: int, folder: Path) -> SweepRun:
    named = {"run.name": f"{variant.name}_seed{seed}", "run.folder": folder, "run.seed": seed}
    return SweepRun(variant, seed, Variant.of(f"seed {seed}", variant.config, named).config)


def _time_file(run: SweepRun) -> Path:
    return run.folder / "training_s.txt"


def _save_training_s(run: SweepRun, seconds: float) -> None:
    with written_whole(_time_file(run)) as stream:
        stream.write(f"{seconds:.1f}\n".encode())


def _save_config(run: SweepRun) -> None:
    """Save the config of a new run; refuse a folder with another config."""
    saved = run.folder / "config.yaml"
    if not saved.exists():
        run.config.save(saved)
    elif load_config(saved).digest() != run.config.digest():
        raise UserError(
            f"{run.folder} holds a network of another config, see {saved}; take another folder"
            " with --work, or the config from before"
        )
