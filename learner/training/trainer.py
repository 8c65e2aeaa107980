"""Training of a network: pre-training, then coupled training in rounds.

    trainer = Trainer(VMDNNRecipe(config, questions), TutoringStore(folder))
    while not trainer.finished:
        trainer.epoch()
    policy = trainer.policy_bytes(version=1)

The same config, seed and sequences give the same network to the last bit, also if the training is
saved and restored in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Self

import torch
from torch import Tensor

from learner.checkpoint import (
    CLASSIFIER_PREFIX,
    NETWORK_PREFIX,
    AskedMetadata,
    Checkpoint,
    CheckpointMetadata,
    CodeRanges,
    RivalMetadata,
    TrainingMetadata,
    check_same_network,
    checkpoint_bytes,
    load_checkpoint,
    save_checkpoint,
)
from learner.tensors import prefixed, to_arrays, to_tensors
from learner.training.memory import keep_freed_memory
from learner.training.optimization import Optimization
from learner.training.recipe import Recipe, StageObjective
from learner.training.schedule import RoundSchedule
from learner.tutoring.selection import Intake
from learner.tutoring.store import TutoringStore
from proto.episode import Episode
from proto.errors import UserError
from proto.metrics import Stage

_OPTIMIZER_PREFIX: Final = "optimizer."
_RANDOM_STATE: Final = "random.state"


class Trainer:
    """Trains one network, epoch by epoch.

    Each epoch begins with the sequences that have come into the store since the last one.

    Attributes:
        recipe: the network, and how it is trained.
        objective: objective of the current stage, or None before its first sequence.
        stage: stage of the last epoch: pre-training or coupled training; or finished.
        epochs_done: epochs done in this stage, in all its rounds.
        loss: mean loss of the last epoch, or None before the first.
        learning_rate: learning rate of the last epoch, or None before the first of this stage and
            after `restore`.
        version: version of the newest policy, 0 for none yet.
    """

    objective: StageObjective | None
    stage: Stage
    epochs_done: int
    loss: float | None
    learning_rate: float | None
    _intake: Intake
    _optimization: Optimization | None

    def __init__(
        self,
        recipe: Recipe,
        store: TutoringStore,
        pretraining_store: TutoringStore | None = None,
        *,
        rounds: int = 0,
    ) -> None:
        """Start from random weights.

        Args:
            recipe: the network, and how it is trained. The number of threads that its config asks
                for in each stage is set for the whole process.
            store: sequences to learn from.
            pretraining_store: sequences for pre-training; without it, those of `store`.
            rounds: rounds of corrections. The caller adds corrections to the store before each.
        """
        config = recipe.config
        keep_freed_memory()
        self.recipe = recipe
        self._store = store
        self._pretraining_store, self._pretraining_task = store, config.task.name
        if pretraining_store is not None:
            self._pretraining_store = pretraining_store
            self._pretraining_task = config.pretraining_task or config.task.name
        self._rounds = RoundSchedule(
            recipe.coupled_epochs, rounds, config.learner.corrections.epochs
        )
        self.version = 0
        self._enter(Stage.PRETRAINING if recipe.pretraining_epochs else Stage.COUPLED)

    @classmethod
    def restore(
        cls,
        path: Path,
        recipe: Recipe,
        store: TutoringStore,
        pretraining_store: TutoringStore | None = None,
        *,
        rounds: int = 0,
    ) -> Self:
        """Go on where `save` was called.

        Args:
            path: file that `save` wrote.
            recipe: see `__init__`, also for the other arguments.
            store: sequences to learn from.
            pretraining_store: sequences for pre-training.
            rounds: rounds of corrections.

        Raises:
            UserError: the checkpoint is missing, damaged, no training state, or of another network.
        """
        checkpoint = load_checkpoint(path)
        metadata = checkpoint.metadata
        check_same_network(recipe.config.network, checkpoint, f"checkpoint {path}")
        if metadata.rival != recipe.rival:
            raise UserError(
                f"checkpoint {path} is of another network: {_kind(metadata.rival)}, not"
                f" {_kind(recipe.rival)}"
            )
        if metadata.training is None:
            raise UserError(
                f"checkpoint {path} is a policy: it can act, but training cannot go on from it;"
                " take a training checkpoint"
            )
        trainer = cls(recipe, store, pretraining_store, rounds=rounds)
        try:
            trainer._resume(checkpoint, metadata.training)
        except (KeyError, RuntimeError) as error:
            raise UserError(f"checkpoint {path} lacks a part of the training: {error}") from error
        return trainer

    @property
    def finished(self) -> bool:
        """Whether all epochs of both stages and all rounds are done."""
        return self.stage is Stage.FINISHED

    @property
    def next_stage(self) -> Stage:
        """Stage of the next epoch."""
        over = self.stage is Stage.PRETRAINING and self.epochs_done >= self.epochs_total
        return Stage.COUPLED if over else self.stage

    @property
    def epochs_total(self) -> int:
        """Epochs of this stage, in all its rounds."""
        if self.stage is Stage.PRETRAINING:
            return self.recipe.pretraining_epochs
        return self._rounds.total

    @property
    def epochs_later(self) -> int:
        """Epochs of the stages after this one."""
        return self._rounds.total if self.stage is Stage.PRETRAINING else 0

    @property
    def round(self) -> int:
        """Round that the next epoch belongs to; 0 before any corrections and in pre-training."""
        return 0 if self.stage is Stage.PRETRAINING else self._rounds.round_at(self.epochs_done)

    @property
    def round_begins(self) -> bool:
        """Whether the next epoch is the first one after a round of corrections."""
        return self.round > 0 and self.epochs_done == self._rounds.start_of(self.round)

    @property
    def sequences(self) -> int:
        """Number of sequences that this stage learns from."""
        return len(self._intake.taken)

    def epoch(self) -> float:
        """Take in new sequences, then show every sequence once; the mean loss.

        Raises:
            UserError: there is no sequence to learn from, or the training diverged.
        """
        if self.finished:
            raise RuntimeError("the training is finished")
        if self.next_stage is not self.stage:
            self._enter(self.next_stage)
        self._take_in(self._intake.new())
        if self.round_begins and self.objective is not None:
            self._optimization = self._new_optimization(self.objective)
        if self._optimization is None:
            raise UserError(self._intake.complaint())
        number = self.epochs_done - self._rounds.start_of(self.round)
        self.loss = loss = self._optimization.epoch(number, self.recipe.generator)
        self.learning_rate = self._optimization.rate_at(number)
        self.epochs_done += 1
        self._finish_if_done()
        return loss

    def policy_bytes(self, version: int) -> bytes:
        """The network as a policy of this version, which becomes the newest.

        Raises:
            RuntimeError: the network cannot act before the first epoch of coupled training.
        """
        if self.objective is None or self.objective.code is None:
            raise RuntimeError("the network cannot act before the first epoch of coupled training")
        self.version = version
        return checkpoint_bytes(Checkpoint(self._metadata(None), to_arrays(self._network_parts())))

    def save(self, path: Path) -> None:
        """Write everything that `restore` needs.

        Raises:
            UserError: the file cannot be written there.
        """
        parts = self._network_parts() | {_RANDOM_STATE: self.recipe.generator.get_state()}
        if self._optimization is not None:
            parts |= prefixed(_OPTIMIZER_PREFIX, self._optimization.tensors())
        if self.objective is not None and self.objective.classifier is not None:
            parts |= prefixed(CLASSIFIER_PREFIX, self.objective.classifier.state_dict())
        metadata = self._metadata(self._training_metadata())
        save_checkpoint(path, Checkpoint(metadata, to_arrays(parts)))

    def _enter(self, stage: Stage) -> None:
        torch.set_num_threads(self._threads(stage))
        self.stage = stage
        self.epochs_done = 0
        self.loss = None
        self.learning_rate = None
        self._intake = self._new_intake()
        self.objective = None
        self._optimization = None

    def _threads(self, stage: Stage) -> int:
        config = self.recipe.config.learner
        asked_for = config.pretraining.threads if stage is Stage.PRETRAINING else None
        return asked_for or config.threads

    def _finish_if_done(self) -> None:
        if self.stage is Stage.COUPLED and self.epochs_done >= self.epochs_total:
            self.stage = Stage.FINISHED

    def _new_intake(self) -> Intake:
        if self.stage is Stage.PRETRAINING:
            variables = self.recipe.pretraining_variables
            return Intake(self._pretraining_store, self._pretraining_task, variables)
        return Intake(self._store, self.recipe.config.task.name)

    def _new_optimization(self, objective: StageObjective) -> Optimization:
        pretraining = self.stage is Stage.PRETRAINING
        epochs = self.epochs_total if pretraining else self._rounds.epochs_of(self.round)
        return Optimization(objective, self.recipe.hyperparameters(self.stage, epochs))

    def _take_in(self, episodes: Sequence[Episode]) -> None:
        if self.objective is None and episodes:
            self._begin(self.recipe.new_objective(self.stage, episodes))
        if self.objective is not None:
            for episode in episodes:
                self.objective.add(episode)

    def _begin(self, objective: StageObjective) -> Optimization:
        self.objective = objective
        self._optimization = self._new_optimization(objective)
        return self._optimization

    def _resume(self, checkpoint: Checkpoint, training: TrainingMetadata) -> None:
        metadata = checkpoint.metadata
        self.recipe.network.load_state_dict(to_tensors(checkpoint.part(NETWORK_PREFIX)))
        self._enter(metadata.stage)
        self.version = metadata.version
        self.epochs_done = metadata.epoch
        self.loss = metadata.loss
        objective = self.recipe.restored_objective(metadata)
        if objective is not None:
            self._begin(objective).load_tensors(to_tensors(checkpoint.part(_OPTIMIZER_PREFIX)))
            for episode in self._intake.again(training.sequences):
                objective.add(episode)
            if objective.classifier is not None:
                classifier = to_tensors(checkpoint.part(CLASSIFIER_PREFIX))
                objective.classifier.load_state_dict(classifier)
        self.recipe.generator.set_state(to_tensors(checkpoint.tensors)[_RANDOM_STATE])
        self._finish_if_done()

    def _metadata(self, training: TrainingMetadata | None) -> CheckpointMetadata:
        config = self.recipe.config
        code = None if self.objective is None else self.objective.code
        ranges = None
        if code is not None:
            ranges = CodeRanges(minima=tuple(code.minima), maxima=tuple(code.maxima))
        return CheckpointMetadata(
            run=config.run.name,
            version=self.version,
            stage=Stage.PRETRAINING if self.stage is Stage.PRETRAINING else Stage.COUPLED,
            epoch=self.epochs_done,
            loss=self.loss,
            config_digest=config.digest(),
            task=config.task.name,
            backend=config.simulator.backend,
            network=config.network,
            code=ranges,
            cases=len(self._intake.situations),
            sequences=self.sequences,
            training=training,
            rival=self.recipe.rival,
        )

    def _training_metadata(self) -> TrainingMetadata:
        asked = () if self.objective is None else self.objective.asked
        return TrainingMetadata(
            sequences=tuple(self._intake.taken),
            asked={
                each.variable: AskedMetadata(classes=each.classes, window=each.window)
                for each in asked
            },
        )

    def _network_parts(self) -> dict[str, Tensor]:
        return prefixed(NETWORK_PREFIX, self.recipe.network.state_dict())


def _kind(rival: RivalMetadata | None) -> str:
    return "VMDNN" if rival is None else f"{rival.kind} with {rival.units} units"
