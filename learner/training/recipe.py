"""The interface between the trainer and the networks that it trains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import nn

from learner.checkpoint import CheckpointMetadata, RivalMetadata
from learner.network.softmax_code import SoftmaxCode
from learner.training.asked import Asked
from learner.training.optimization import Hyperparameters, Objective
from proto.config import Config
from proto.episode import Episode
from proto.metrics import Stage


class StageObjective(Objective, Protocol):
    """Objective of one stage of a training, with what a checkpoint keeps of it."""

    @property
    def code(self) -> SoftmaxCode | None:
        """How the outputs code actions; None in a stage in which the network cannot act yet."""

    @property
    def asked(self) -> Sequence[Asked]:
        """What the classifier is asked, in the order of its outputs; may be empty."""

    @property
    def classifier(self) -> nn.Module | None:
        """A temporary layer that is trained in this stage only, or None."""


class Recipe(Protocol):
    """A network, and how it is trained in two stages: pre-training and coupled training."""

    @property
    def config(self) -> Config:
        """Everything the training depends on."""

    @property
    def network(self) -> nn.Module:
        """The network; its weights are random at first."""

    @property
    def generator(self) -> torch.Generator:
        """Draws everything random in the training."""

    @property
    def rival(self) -> RivalMetadata | None:
        """Kind and size of a network that VMDNN is compared with; None for VMDNN."""

    @property
    def pretraining_epochs(self) -> int:
        """Epochs of pre-training; zero leaves it out."""

    @property
    def coupled_epochs(self) -> int:
        """Epochs of coupled training before any corrections."""

    @property
    def publish_every_epochs(self) -> int | None:
        """Coupled training gives a policy every so many epochs; None for at its end only."""

    @property
    def pretraining_variables(self) -> Sequence[str]:
        """Names of the variables that situations must have in pre-training."""

    def hyperparameters(self, stage: Stage, epochs: int) -> Hyperparameters:
        """Settings of one optimization.

        Args:
            stage: pre-training or coupled training.
            epochs: epochs of the stage, or of one round of it.
        """

    def new_objective(self, stage: Stage, episodes: Sequence[Episode]) -> StageObjective:
        """Objective of a stage, without sequences.

        Args:
            stage: pre-training or coupled training.
            episodes: they fix the classes or the ranges of the actions; not empty.
        """

    def restored_objective(self, metadata: CheckpointMetadata) -> StageObjective | None:
        """Objective of a checkpoint, without sequences; None if its stage had none yet."""
