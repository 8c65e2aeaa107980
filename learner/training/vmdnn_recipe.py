"""How VMDNN is trained: pre-training of the vision, then coupled training of the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from learner.checkpoint import CheckpointMetadata
from learner.network.softmax_code import SoftmaxCode
from learner.network.vmdnn import VMDNN
from learner.training.coupled import CoupledTraining
from learner.training.optimization import Hyperparameters
from learner.training.pretraining import Classes, Pretraining, classes_of
from proto.config import Config
from proto.episode import Episode
from proto.metrics import Stage


class VMDNNRecipe:
    """The `Recipe` of VMDNN."""

    rival = None

    def __init__(self, config: Config) -> None:
        """Make a network with random weights."""
        self.config = config
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
    def pretraining_values(self) -> Sequence[str]:
        """Names of the values that pre-training classifies."""
        return tuple(self._labels)

    @property
    def _labels(self) -> Mapping[str, int]:
        return self.config.learner.pretraining.labels

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
            return self._pretraining(classes_of(episodes, self._labels))
        return self._coupled_training(code_of(episodes, self.config))

    def restored_objective(
        self, metadata: CheckpointMetadata
    ) -> Pretraining | CoupledTraining | None:
        """Objective of a checkpoint, or None if its stage had not begun."""
        code = metadata.softmax_code()
        if code is not None:
            return self._coupled_training(code)
        classes = metadata.training.classes if metadata.training else {}
        return self._pretraining(classes) if classes else None

    def _pretraining(self, classes: Classes) -> Pretraining:
        config = self.config.learner.pretraining
        return Pretraining(self.network, classes, config, self.generator)

    def _coupled_training(self, code: SoftmaxCode) -> CoupledTraining:
        return CoupledTraining(self.network, code, self.config.learner, self.generator)


def code_of(episodes: Sequence[Episode], config: Config) -> SoftmaxCode:
    """A code for the ranges that the targets of some episodes span."""
    targets = np.concatenate([episode.targets for episode in episodes])
    return SoftmaxCode.of_actions(targets, config.network)
