"""How VMDNN is trained: pre-training of the vision, then coupled training of the rest."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import torch

from learner.checkpoint import CheckpointMetadata
from learner.network.softmax_code import SoftmaxCode
from learner.network.vmdnn import VMDNN
from learner.training.asked import Asked
from learner.training.coupled import CoupledTraining
from learner.training.optimization import Hyperparameters
from learner.training.pretraining import Pretraining
from proto.config import Config
from proto.episode import Episode
from proto.errors import UserError
from proto.metrics import Stage
from proto.variables import Question


class VMDNNRecipe:
    """The `Recipe` of VMDNN."""

    rival = None

    def __init__(
        self, config: Config, questions: Sequence[Question], distractors: Collection[str] = ()
    ) -> None:
        """Make a network with random weights.

        Args:
            config: everything the training depends on.
            questions: what pre-training asks about the situations of its task.
            distractors: variables that the actions do not depend on, see `NeighbourGrid`.

        Raises:
            UserError: pre-training has nothing to ask.
        """
        if config.learner.pretraining.epochs and not questions:
            raise UserError(
                f"the task {config.pretraining_task or config.task.name} asks no questions, so it"
                " cannot be pre-trained on: set learner.pretraining.epochs=0"
            )
        self.config = config
        self._questions = tuple(questions)
        self._distractors = distractors
        self.generator = torch.Generator().manual_seed(config.run.seed)
        self.network = VMDNN(config.network)
        self.network.initialize(
            self.generator,
            initial_range=config.learner.initial_range,
            pfc_input_range=config.learner.initial_range_pfc_input,
        )

    @property
    def pretraining_epochs(self) -> int:
        """Epochs of pre-training."""
        return self.config.learner.pretraining.epochs

    @property
    def coupled_epochs(self) -> int:
        """Epochs of coupled training before any corrections."""
        return self.config.learner.epochs

    @property
    def publish_every_epochs(self) -> int:
        """Coupled training gives a policy every so many epochs."""
        return self.config.learner.publish_every_epochs

    @property
    def pretraining_variables(self) -> Sequence[str]:
        """Names of the variables that pre-training asks for."""
        return tuple(question.variable for question in self._questions)

    def hyperparameters(self, stage: Stage, epochs: int) -> Hyperparameters:
        """Settings of the optimization of a stage, or of one round of it."""
        learner = self.config.learner
        pretraining = stage is Stage.PRETRAINING
        return Hyperparameters(
            epochs=epochs,
            rate=learner.pretraining.rate if pretraining else learner.rate,
            schedule=learner.schedule,
            warmup_epochs=0 if pretraining else learner.warmup_epochs,
            batch=learner.pretraining.batch if pretraining else learner.batch,
            clip_norm=learner.clip_norm,
        )

    def new_objective(
        self, stage: Stage, episodes: Sequence[Episode]
    ) -> Pretraining | CoupledTraining:
        """Objective of a stage; its classes or ranges are those of the episodes."""
        if stage is Stage.PRETRAINING:
            return self._pretraining([Asked.of(each, episodes) for each in self._questions])
        return self._coupled_training(code_of(episodes, self.config))

    def restored_objective(
        self, metadata: CheckpointMetadata
    ) -> Pretraining | CoupledTraining | None:
        """Objective of a checkpoint, or None if its stage had not begun."""
        code = metadata.softmax_code()
        if code is not None:
            return self._coupled_training(code)
        asked = metadata.training.asked if metadata.training else {}
        if not asked:
            return None
        return self._pretraining([Asked(n, each.classes, each.window) for n, each in asked.items()])

    def _pretraining(self, asked: Sequence[Asked]) -> Pretraining:
        config = self.config.learner.pretraining
        return Pretraining(self.network, asked, config, self.generator)

    def _coupled_training(self, code: SoftmaxCode) -> CoupledTraining:
        return CoupledTraining(
            self.network, code, self.config.learner, self.generator, self._distractors
        )


def code_of(episodes: Sequence[Episode], config: Config) -> SoftmaxCode:
    """A code for the ranges that the targets of some episodes span."""
    targets = np.concatenate([episode.targets for episode in episodes])
    return SoftmaxCode.of_actions(targets, config.network)
