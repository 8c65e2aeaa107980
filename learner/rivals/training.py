"""Training of a rival on tutored sequences, in two stages.

It has all that helps VMDNN: disturbed pictures while the vision is formed, then disturbed features
and mixtures of neighbouring situations; warm-up, schedule and clipping. Its vision is formed by the
task itself, with no classifier of situations in between.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Final, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from learner.checkpoint import (
    NETWORK_PREFIX,
    Checkpoint,
    CheckpointMetadata,
    CodeRanges,
    RivalMetadata,
    TrainingMetadata,
    check_same_network,
    checkpoint_bytes,
    load_checkpoint,
    policy_file,
    save_checkpoint,
    training_file,
)
from learner.network.softmax_code import SoftmaxCode
from learner.network.vision_input import vision_input
from learner.rivals.networks import FEATURES, Rival, make_rival, rival_config
from learner.training.augmentation import disturbed
from learner.training.interpolation import Cells, mixed
from learner.training.loss import kl_divergence
from learner.training.optimization import Optimization, Plan
from learner.training.sequences import Sequences
from learner.tutoring.selection import Intake
from learner.tutoring.store import TutoringStore
from proto.config import Config, LearnerConfig, RivalConfig, RivalKind
from proto.episode import Episode
from proto.errors import UserError
from proto.metrics import Stage
from proto.storage import written_whole

_OPTIMIZER_PREFIX: Final = "optimizer."
_RANDOM_STATE: Final = "random.state"


class Together:
    """First stage: from disturbed pictures to outputs.

    Attributes:
        parameters: what is trained: everything.
    """

    def __init__(
        self,
        network: Rival,
        code: SoftmaxCode,
        config: RivalConfig,
        generator: torch.Generator,
    ) -> None:
        """Begin without sequences; `generator` draws the disturbance."""
        self.parameters = list(network.parameters())
        self._network = network
        self._code = code
        self._config = config
        self._generator = generator
        self._images: list[Tensor] = []
        self._codes: list[Tensor] = []

    def __len__(self) -> int:
        return len(self._images)

    def add(self, episode: Episode) -> None:
        """Take a sequence in."""
        self._images.append(torch.from_numpy(episode.images))
        self._codes.append(torch.from_numpy(self._code.encode(episode.targets)))

    def add_gradients(self, chosen: Tensor) -> float:
        """Mean divergence of eq. (5), for the sequences with these indices; adds its gradients."""
        grey = pad_sequence([self._images[index] for index in chosen], batch_first=True)
        images = torch.from_numpy(vision_input(grey.numpy()))
        seen = self._network.see(disturbed(images, self._config, self._generator))
        codes = [self._codes[index] for index in chosen]
        return _add_gradients(self._network, Sequences.stacked(list(seen), codes))


class Coupled:
    """Second stage: the vision stays, the rest learns on from mixtures of neighbours.

    Attributes:
        parameters: what is trained: everything but the eye.
    """

    def __init__(
        self,
        network: Rival,
        code: SoftmaxCode,
        config: LearnerConfig,
        generator: torch.Generator,
    ) -> None:
        """Begin without sequences; `generator` draws mixtures and disturbance."""
        self.parameters = network.coupled_parameters()
        self._network = network
        self._code = code
        self._config = config
        self._generator = generator
        self._episodes: list[Episode] = []

    def __len__(self) -> int:
        return len(self._episodes)

    def add(self, episode: Episode) -> None:
        """Take a sequence in."""
        self._episodes.append(episode)

    def add_gradients(self, chosen: Tensor) -> float:
        """Mean divergence of eq. (5), for the sequences with these indices; adds its gradients."""
        mixtures = self._cells.mixtures(chosen, self._config.interpolation, self._generator)
        sequences = mixed(mixtures, self._sequences, self._targets, self._code)
        wrong = torch.randn(len(chosen), 1, FEATURES, generator=self._generator)
        shift = self._config.vision_noise * self._spread * wrong
        return _add_gradients(self._network, replace(sequences, seen=sequences.seen + shift))

    @cached_property
    def _sequences(self) -> Sequences:
        with torch.no_grad():
            seen = [
                self._network.see(torch.from_numpy(vision_input(episode.images))[None])[0]
                for episode in self._episodes
            ]
        codes = [torch.from_numpy(self._code.encode(each.targets)) for each in self._episodes]
        return Sequences.stacked(seen, codes)

    @cached_property
    def _spread(self) -> Tensor:
        return self._sequences.seen.std((0, 1))

    @cached_property
    def _targets(self) -> Tensor:
        return pad_sequence([torch.from_numpy(each.targets) for each in self._episodes], True)

    @cached_property
    def _cells(self) -> Cells:
        situations = [episode.situation for episode in self._episodes]
        return Cells(situations, [episode.steps for episode in self._episodes])


def _add_gradients(network: Rival, sequences: Sequences) -> float:
    log_outputs, _ = network.act(sequences.seen)
    loss = kl_divergence(log_outputs, sequences.codes, sequences.mask)
    loss.backward()  # type: ignore[no-untyped-call]
    return loss.item()


class RivalTrainer:
    """Trains one rival, epoch by epoch; the same config and sequences give the same network.

    Attributes:
        stage: that of the last epoch: pre-training (eye and rest together) or coupled training.
        epochs_done: epochs done in this stage.
        loss: mean loss of the last epoch, or None before the first.
    """

    stage: Stage
    epochs_done: int
    loss: float | None

    def __init__(self, config: Config, kind: RivalKind, store: TutoringStore) -> None:
        """Start from random weights.

        Raises:
            UserError: there is no sequence to learn from.
        """
        torch.set_num_threads(config.learner.threads)
        intake = Intake(store, config.task.name)
        self._episodes = intake.new()
        if not self._episodes:
            raise UserError(intake.complaint())
        self._config, self._kind = config, kind
        self._rival = rival_config(config.comparison, kind)
        self._sequences = tuple(intake.taken)
        self._generator = torch.Generator().manual_seed(config.run.seed)
        self._network = make_rival(kind, self._rival.units, config.network, config.run.seed)
        targets = np.concatenate([episode.targets for episode in self._episodes])
        self._code = SoftmaxCode.of_actions(targets, config.network)
        self._enter(Stage.PRETRAINING)

    @classmethod
    def restore(cls, path: Path, config: Config, kind: RivalKind, store: TutoringStore) -> Self:
        """Go on where `save` was called.

        Raises:
            UserError: the checkpoint is missing, damaged, or of another network or other sequences.
        """
        checkpoint = load_checkpoint(path)
        check_same_network(config.network, checkpoint, f"checkpoint {path}")
        trainer = cls(config, kind, store)
        saved, wanted = checkpoint.metadata, trainer._metadata()
        if (saved.rival, saved.training) != (wanted.rival, wanted.training):
            raise UserError(f"checkpoint {path} is of another network or of other sequences")
        trainer._network.load_state_dict(_tensors(checkpoint, NETWORK_PREFIX))
        trainer._enter(saved.stage)
        trainer._optimization.load_tensors(_tensors(checkpoint, _OPTIMIZER_PREFIX))
        trainer._generator.set_state(torch.tensor(checkpoint.tensors[_RANDOM_STATE]))
        trainer.epochs_done, trainer.loss = saved.epoch, saved.loss
        return trainer

    @property
    def finished(self) -> bool:
        """Whether all epochs of both stages are done."""
        return self.stage is Stage.COUPLED and self.epochs_done >= self._rival.epochs

    def epoch(self) -> float:
        """Show every sequence once; the mean loss."""
        if self.stage is Stage.PRETRAINING and self.epochs_done >= self._rival.together_epochs:
            self._enter(Stage.COUPLED)
        self.loss = loss = self._optimization.epoch(self.epochs_done, self._generator)
        self.epochs_done += 1
        return loss

    def policy_bytes(self) -> bytes:
        """The network as a policy, weights and metadata alone."""
        metadata = self._metadata().model_copy(update={"training": None})
        return checkpoint_bytes(Checkpoint(metadata, _arrays(self._parts())))

    def save(self, path: Path) -> None:
        """Write all that `restore` needs."""
        optimizer = self._optimization.tensors()
        parts = self._parts() | {f"{_OPTIMIZER_PREFIX}{key}": optimizer[key] for key in optimizer}
        parts[_RANDOM_STATE] = self._generator.get_state()
        save_checkpoint(path, Checkpoint(self._metadata(), _arrays(parts)))

    def _enter(self, stage: Stage) -> None:
        self.stage, self.epochs_done, self.loss = stage, 0, None
        lesson = self._lesson()
        for episode in self._episodes:
            lesson.add(episode)
        self._optimization = Optimization(lesson, self._plan())

    def _lesson(self) -> Together | Coupled:
        if self.stage is Stage.PRETRAINING:
            return Together(self._network, self._code, self._rival, self._generator)
        return Coupled(self._network, self._code, self._config.learner, self._generator)

    def _plan(self) -> Plan:
        learner, rival = self._config.learner, self._rival
        together = self.stage is Stage.PRETRAINING
        return Plan(
            rival.together_epochs if together else rival.epochs,
            rival.rate,
            learner.schedule,
            learner.warmup_epochs,
            learner.batch,
            learner.clip_norm,
        )

    def _metadata(self) -> CheckpointMetadata:
        return CheckpointMetadata(
            run=self._config.run.name,
            version=int(self.finished),  # there is one policy, at the end
            stage=self.stage,
            epoch=self.epochs_done,
            loss=self.loss,
            config_digest=self._config.digest(),
            network=self._config.network,
            code=CodeRanges(minima=tuple(self._code.minima), maxima=tuple(self._code.maxima)),
            training=TrainingMetadata(sequences=self._sequences, classes={}),
            rival=RivalMetadata(kind=self._kind, units=self._rival.units),
        )

    def _parts(self) -> dict[str, Tensor]:
        state = self._network.state_dict()
        return {f"{NETWORK_PREFIX}{name}": tensor for name, tensor in state.items()}


def train_rival(
    config: Config,
    kind: RivalKind,
    folder: Path,
    store: TutoringStore,
    go_on: Callable[[float], bool],
) -> bool:
    """Train into a folder, or go on with what is in it; whether it is finished.

    Args:
        config: everything the training depends on.
        kind: which network.
        folder: gets checkpoints, and the policy at the end.
        store: its tutored sequences.
        go_on: called with the loss after each epoch; False stops the training.
    """
    path = training_file(folder)
    if path.exists():
        trainer = RivalTrainer.restore(path, config, kind, store)
    else:
        trainer = RivalTrainer(config, kind, store)
    going = True
    while going and not trainer.finished:
        going = go_on(trainer.epoch())
        if trainer.epochs_done % config.learner.checkpoint_every_epochs == 0:
            trainer.save(path)
    if trainer.finished:
        with written_whole(policy_file(folder, 1)) as stream:
            stream.write(trainer.policy_bytes())
    trainer.save(path)
    return trainer.finished


def _arrays(tensors: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    return {name: tensor.numpy() for name, tensor in tensors.items()}


def _tensors(checkpoint: Checkpoint, prefix: str) -> dict[str, Tensor]:
    return {name: torch.tensor(array) for name, array in checkpoint.part(prefix).items()}
