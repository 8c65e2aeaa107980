"""Training of VMDNN: pre-training of the vision, then coupled training of the rest, in laps.

    trainer = Trainer(config, TutoringStore(folder))
    while not trainer.finished:
        trainer.epoch()
    policy = trainer.policy_bytes(version=1)

The same config, seed and sequences give the same network to the last bit, and so does a training
that was saved and restored in between.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.checkpoint import (
    CLASSIFIER_PREFIX,
    NETWORK_PREFIX,
    Checkpoint,
    CheckpointMetadata,
    Classes,
    CodeRanges,
    Tensors,
    TrainingMetadata,
    check_same_network,
    checkpoint_bytes,
    load_checkpoint,
    save_checkpoint,
)
from learner.network.softmax_code import SoftmaxCode
from learner.network.vmdnn import VMDNN
from learner.training.coupled import CoupledTraining
from learner.training.optimization import Optimization, Plan
from learner.training.pretraining import Asked, Pretraining, classes_of
from learner.training.schedule import Laps
from learner.tutoring.selection import Intake
from learner.tutoring.store import TutoringStore
from proto.config import Config
from proto.episode import Episode
from proto.errors import UserError
from proto.metrics import Stage
from proto.variables import Question

_OPTIMIZER_PREFIX: Final = "optimizer."
_RANDOM_STATE: Final = "random.state"


class Trainer:
    """Trains one network, epoch by epoch.

    Sequences that come into the store while training goes on are taken in at the next epoch.

    Attributes:
        network: the network.
        stage: that of the last epoch: pre-training or coupled training; or finished.
        epochs_done: epochs done in this stage, in all laps of it.
        loss: mean loss of the last epoch, or None before the first.
        version: version of the newest policy, 0 for none yet.
    """

    stage: Stage
    epochs_done: int
    loss: float | None
    _intake: Intake
    _lesson: Pretraining | CoupledTraining | None
    _optimization: Optimization | None

    def __init__(
        self,
        config: Config,
        store: TutoringStore,
        pretraining_store: TutoringStore | None = None,
        *,
        questions: Sequence[Question] = (),
        rounds: int = 0,
    ) -> None:
        """Start from random weights.

        Args:
            config: everything the training depends on. Its number of threads is set for the whole
                process.
            store: sequences to learn from.
            pretraining_store: sequences for pre-training, when they are others (the paper's have
                no obstacle).
            questions: what pre-training asks about the situations of its task.
            rounds: laps that follow the first, after corrections that somebody adds to the store.
        """
        if config.learner.pretraining.epochs and not questions:
            raise UserError(
                f"the task {config.pretraining_task or config.task.name} asks no questions, so it"
                " cannot be pre-trained on: set learner.pretraining.epochs=0"
            )
        torch.set_num_threads(config.learner.threads)
        self._config = config
        self._questions = tuple(questions)
        self._store = store
        self._pretraining_store = store if pretraining_store is None else pretraining_store
        learner = config.learner
        self._laps = Laps(learner.epochs, rounds, learner.corrections.epochs)
        self._generator = torch.Generator().manual_seed(config.run.seed)
        self.network = VMDNN(config.network)
        self.network.initialize(
            self._generator,
            initial_range=config.learner.initial_range,
            pfc_input_range=config.learner.initial_range_pfc_input,
        )
        self.version = 0
        self._enter(Stage.PRETRAINING if config.learner.pretraining.epochs else Stage.COUPLED)

    @classmethod
    def restore(
        cls,
        path: Path,
        config: Config,
        store: TutoringStore,
        pretraining_store: TutoringStore | None = None,
        *,
        questions: Sequence[Question] = (),
        rounds: int = 0,
    ) -> Self:
        """Go on where `save` was called.

        Raises:
            UserError: the checkpoint is missing, damaged, no training state, or of another network.
        """
        checkpoint = load_checkpoint(path)
        check_same_network(config.network, checkpoint, f"checkpoint {path}")
        training = checkpoint.metadata.training
        if training is None:
            raise UserError(
                f"checkpoint {path} is a policy: it can act, but training cannot go on from it;"
                " take a training checkpoint"
            )
        trainer = cls(config, store, pretraining_store, questions=questions, rounds=rounds)
        try:
            trainer._resume(checkpoint, training)
        except (KeyError, RuntimeError) as error:
            raise UserError(f"checkpoint {path} lacks a part of the training: {error}") from error
        return trainer

    @property
    def finished(self) -> bool:
        """Whether all epochs of both stages and all laps are done."""
        return self.stage is Stage.FINISHED

    @property
    def next_stage(self) -> Stage:
        """Stage of the next epoch."""
        over = self.stage is Stage.PRETRAINING and self.epochs_done >= self.epochs_total
        return Stage.COUPLED if over else self.stage

    @property
    def epochs_total(self) -> int:
        """Epochs that this stage has, in all laps of it."""
        pretraining = self._config.learner.pretraining
        return pretraining.epochs if self.stage is Stage.PRETRAINING else self._laps.total

    @property
    def round(self) -> int:
        """Round of corrections, from 1, that the next epoch belongs to; 0 in the first lap."""
        return 0 if self.stage is Stage.PRETRAINING else self._laps.round_at(self.epochs_done)

    @property
    def round_begins(self) -> bool:
        """Whether the next epoch is the first after a round of corrections."""
        return self.round > 0 and self.epochs_done == self._laps.start_of(self.round)

    @property
    def sequences(self) -> int:
        """Sequences that this stage learns from."""
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
        if self.round_begins and self._lesson is not None:
            self._optimization = Optimization(self._lesson, self._plan())
        if self._optimization is None:
            raise UserError(self._intake.complaint())
        in_lap = self.epochs_done - self._laps.start_of(self.round)
        self.loss = loss = self._optimization.epoch(in_lap, self._generator)
        self.epochs_done += 1
        self._finish_if_done()
        return loss

    def mean_errors(self) -> NDArray[np.float64]:
        """(11,) mean distance of the decoded outputs from the targets, over all sequences.

        The network sees the tutor's pictures here, not what its own actions would show it.
        """
        return self._coupled().mean_errors()

    def policy_bytes(self, version: int) -> bytes:
        """The network as a policy of this version, which becomes the newest."""
        self._coupled()
        self.version = version
        return checkpoint_bytes(Checkpoint(self._metadata(None), _arrays(self._network_parts())))

    def save(self, path: Path) -> None:
        """Write all that `restore` needs.

        Raises:
            UserError: the file cannot be written there.
        """
        parts = self._network_parts() | {_RANDOM_STATE: self._generator.get_state()}
        if self._optimization is not None:
            parts |= _prefixed(_OPTIMIZER_PREFIX, self._optimization.tensors())
        if isinstance(self._lesson, Pretraining):
            parts |= _prefixed(CLASSIFIER_PREFIX, self._lesson.classifier.state_dict())
        save_checkpoint(path, Checkpoint(self._metadata(self._training_metadata()), _arrays(parts)))

    def _enter(self, stage: Stage) -> None:
        self.stage = stage
        self.epochs_done = 0
        self.loss = None
        self._intake = self._make_intake()
        self._lesson = None
        self._optimization = None

    def _finish_if_done(self) -> None:
        if self.stage is Stage.COUPLED and self.epochs_done >= self.epochs_total:
            self.stage = Stage.FINISHED

    def _make_intake(self) -> Intake:
        task = self._config.task.name
        if self.stage is Stage.PRETRAINING:
            asked = (question.variable for question in self._questions)
            return Intake(self._pretraining_store, self._config.pretraining_task or task, asked)
        return Intake(self._store, task)

    def _plan(self) -> Plan:
        learner = self._config.learner
        if self.stage is Stage.PRETRAINING:
            first = learner.pretraining
            return Plan(
                first.epochs, first.rate, learner.schedule, 0, first.batch, learner.clip_norm
            )
        return Plan(
            self._laps.length_of(self.round),
            learner.rate,
            learner.schedule,
            learner.warmup_epochs,
            learner.batch,
            learner.clip_norm,
        )

    def _take_in(self, episodes: Sequence[Episode]) -> None:
        if self._lesson is None and episodes:
            self._begin(self._first_lesson(episodes))
        if self._lesson is not None:
            for episode in episodes:
                self._lesson.add(episode)

    def _begin(self, lesson: Pretraining | CoupledTraining) -> Optimization:
        self._lesson = lesson
        self._optimization = Optimization(lesson, self._plan())
        return self._optimization

    def _first_lesson(self, episodes: Sequence[Episode]) -> Pretraining | CoupledTraining:
        """The lesson of this stage, its classes or ranges fixed from the first sequences."""
        if self.stage is Stage.PRETRAINING:
            return self._pretraining(classes_of(episodes, self._questions))
        targets = np.concatenate([episode.targets for episode in episodes])
        code = SoftmaxCode.of_actions(targets, self._config.network)
        return self._coupled_training(code)

    def _pretraining(self, classes: Mapping[str, Classes]) -> Pretraining:
        windows = {question.variable: question.window for question in self._questions}
        asked = [Asked(name, each, windows[name]) for name, each in classes.items()]
        return Pretraining(self.network, asked, self._config.learner.pretraining, self._generator)

    def _coupled_training(self, code: SoftmaxCode) -> CoupledTraining:
        return CoupledTraining(self.network, code, self._config.learner, self._generator)

    def _coupled(self) -> CoupledTraining:
        if not isinstance(self._lesson, CoupledTraining):
            raise RuntimeError("the network cannot act before the first epoch of coupled training")
        return self._lesson

    def _resume(self, checkpoint: Checkpoint, training: TrainingMetadata) -> None:
        metadata = checkpoint.metadata
        self.network.load_state_dict(_tensors(checkpoint.part(NETWORK_PREFIX)))
        self._enter(metadata.stage)
        self.version = metadata.version
        self.epochs_done = metadata.epoch
        self.loss = metadata.loss
        lesson = self._lesson_of(metadata, training)
        if lesson is not None:
            self._begin(lesson).load_tensors(_tensors(checkpoint.part(_OPTIMIZER_PREFIX)))
            for episode in self._intake.again(training.sequences):
                lesson.add(episode)
        if isinstance(lesson, Pretraining):
            lesson.classifier.load_state_dict(_tensors(checkpoint.part(CLASSIFIER_PREFIX)))
        self._generator.set_state(_tensors(checkpoint.tensors)[_RANDOM_STATE])
        self._finish_if_done()

    def _lesson_of(
        self, metadata: CheckpointMetadata, training: TrainingMetadata
    ) -> Pretraining | CoupledTraining | None:
        code = metadata.softmax_code()
        if code is not None:
            return self._coupled_training(code)
        return self._pretraining(training.classes) if training.classes else None

    def _metadata(self, training: TrainingMetadata | None) -> CheckpointMetadata:
        code = None
        if isinstance(self._lesson, CoupledTraining):
            ranges = self._lesson.code
            code = CodeRanges(minima=tuple(ranges.minima), maxima=tuple(ranges.maxima))
        return CheckpointMetadata(
            run=self._config.run.name,
            version=self.version,
            stage=Stage.PRETRAINING if self.stage is Stage.PRETRAINING else Stage.COUPLED,
            epoch=self.epochs_done,
            loss=self.loss,
            config_digest=self._config.digest(),
            task=self._config.task.name,
            backend=self._config.simulator.backend,
            network=self._config.network,
            code=code,
            cases=len(self._intake.situations),
            sequences=self.sequences,
            training=training,
        )

    def _training_metadata(self) -> TrainingMetadata:
        sequences = tuple(self._intake.taken)
        if not isinstance(self._lesson, Pretraining):
            return TrainingMetadata(sequences=sequences, classes={})
        asked = self._lesson.asked
        return TrainingMetadata(
            sequences=sequences,
            classes={each.variable: each.classes for each in asked},
            windows={each.variable: each.window for each in asked},
        )

    def _network_parts(self) -> dict[str, Tensor]:
        return _prefixed(NETWORK_PREFIX, self.network.state_dict())


def _prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {f"{prefix}{name}": tensor for name, tensor in tensors.items()}


def _arrays(tensors: Mapping[str, Tensor]) -> dict[str, NDArray[np.generic]]:
    return {name: tensor.numpy() for name, tensor in tensors.items()}


def _tensors(arrays: Tensors) -> dict[str, Tensor]:
    return {name: torch.tensor(array) for name, array in arrays.items()}
