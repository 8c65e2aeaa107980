"""How a rival is trained on tutored sequences.

It gets everything that helps VMDNN: augmented images while its vision is formed, then vision noise
and mixtures of neighbouring situations; warm-up, schedule and clipping. The task itself forms its
vision, without a classifier of situations.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import torch
from torch import Tensor

from learner.checkpoint import CheckpointMetadata, RivalMetadata
from learner.network.softmax_code import SoftmaxCode
from learner.rivals.networks import Rival, make_rival, rival_config
from learner.training.asked import Asked
from learner.training.augmentation import augmented_input
from learner.training.coupled import CoupledObjective
from learner.training.divergence import backward
from learner.training.optimization import Hyperparameters
from learner.training.recipe import Recipe
from learner.training.sequences import Minibatch, Sequences
from learner.training.vmdnn_recipe import VMDNNRecipe, code_of
from proto.config import Config, LearnerConfig, RivalConfig, RivalKind
from proto.episode import Episode, Image
from proto.metrics import Stage
from proto.variables import Question


class EndToEndTraining:
    """Objective of the first stage: outputs from augmented images.

    Attributes:
        code: how the outputs code actions.
        asked: always empty.
        classifier: always None.
        parameters: what is trained: everything.
    """

    asked: Sequence[Asked] = ()
    classifier = None

    def __init__(
        self, network: Rival, code: SoftmaxCode, config: RivalConfig, generator: torch.Generator
    ) -> None:
        """Start without sequences; `generator` draws the augmentation."""
        self.code = code
        self.parameters = list(network.parameters())
        self._network = network
        self._generator = generator
        self._config = config
        self._images: list[Image] = []
        self._codes: list[Tensor] = []

    def __len__(self) -> int:
        return len(self._images)

    def add(self, episode: Episode) -> None:
        """Add a sequence."""
        self._images.append(episode.images)
        self._codes.append(torch.from_numpy(self.code.encode(episode.targets)))

    def add_gradients(self, chosen: Tensor) -> float:
        """Mean divergence of eq. (5), for the sequences with these indices; adds its gradients."""
        images = [self._images[index] for index in chosen]
        seen = self._network.see(augmented_input(images, self._config, self._generator))
        codes = [self._codes[index] for index in chosen]
        minibatch = Minibatch.of_all(Sequences.stacked(list(seen), codes))
        return _add_gradients(self._network, minibatch)


class RivalCoupledTraining(CoupledObjective):
    """Objective of the second stage: outputs from mixtures of what the fixed vision sees.

    Attributes:
        parameters: what is trained: everything but the vision.
    """

    def __init__(
        self,
        network: Rival,
        code: SoftmaxCode,
        config: LearnerConfig,
        generator: torch.Generator,
        distractors: Collection[str] = (),
    ) -> None:
        """Start without sequences; `generator` draws mixtures and vision noise."""
        super().__init__(network.see, code, generator, distractors)
        self.parameters = network.coupled_parameters()
        self._network = network
        self._config = config

    def add_gradients(self, chosen: Tensor) -> float:
        """Mean divergence of eq. (5), for the sequences with these indices; adds its gradients."""
        # VMDNN draws the noise first; published results of both depend on the order
        mixed = self.mixed(chosen, self._config.interpolation)
        noise = self.vision_noise(len(chosen), self._config.vision_noise)
        return _add_gradients(self._network, Minibatch.of_all(mixed, noise))


def _add_gradients(network: Rival, minibatch: Minibatch) -> float:
    """Mean divergence of eq. (5); adds its gradients."""
    log_outputs, _ = network.act(minibatch.seen())
    return backward(minibatch.divergence(log_outputs))


class RivalRecipe:
    """The `Recipe` of a rival."""

    publish_every_epochs = None
    pretraining_variables: Sequence[str] = ()

    def __init__(self, config: Config, kind: RivalKind, distractors: Collection[str] = ()) -> None:
        """Make a network with random weights; for the distractors see `NeighbourGrid`."""
        self.config = config
        self._distractors = distractors
        self.generator = torch.Generator().manual_seed(config.run.seed)
        self._settings = rival_config(config.comparison, kind)
        units = self._settings.units
        self.network = make_rival(kind, units, config.network, config.run.seed)
        self.rival = RivalMetadata(kind=kind, units=units)

    @property
    def pretraining_epochs(self) -> int:
        """Epochs of the first stage."""
        return self._settings.together_epochs

    @property
    def coupled_epochs(self) -> int:
        """Epochs of the second stage."""
        return self._settings.epochs

    def hyperparameters(self, stage: Stage, epochs: int) -> Hyperparameters:  # noqa: ARG002
        """Settings of the optimization, the same in both stages."""
        learner = self.config.learner
        return Hyperparameters(
            epochs=epochs,
            rate=self._settings.rate,
            schedule=learner.schedule,
            warmup_epochs=learner.warmup_epochs,
            batch=learner.batch,
            clip_norm=learner.clip_norm,
        )

    def new_objective(
        self, stage: Stage, episodes: Sequence[Episode]
    ) -> EndToEndTraining | RivalCoupledTraining:
        """Objective of a stage; its ranges are those of the episodes."""
        return self._objective(stage, code_of(episodes, self.config))

    def restored_objective(
        self, metadata: CheckpointMetadata
    ) -> EndToEndTraining | RivalCoupledTraining | None:
        """Objective of a checkpoint, or None if its stage had none yet."""
        code = metadata.softmax_code()
        return None if code is None else self._objective(metadata.stage, code)

    def _objective(
        self, stage: Stage, code: SoftmaxCode
    ) -> EndToEndTraining | RivalCoupledTraining:
        if stage is Stage.PRETRAINING:
            return EndToEndTraining(self.network, code, self._settings, self.generator)
        return RivalCoupledTraining(
            self.network, code, self.config.learner, self.generator, self._distractors
        )


def make_recipe(
    config: Config,
    rival: RivalKind | None,
    questions: Sequence[Question] = (),
    distractors: Collection[str] = (),
) -> Recipe:
    """The recipe of a rival, or of VMDNN if `rival` is None; only that asks questions."""
    if rival is None:
        return VMDNNRecipe(config, questions, distractors)
    return RivalRecipe(config, rival, distractors)
