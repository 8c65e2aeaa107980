"""Pre-training of the vision as a delayed-response classifier (paper, section 3.3).

The network watches a whole sequence. Only at its end it is asked, through a temporary softmax on
the PFC, where the object was and how it lay. What answers are asked for, and in how many classes,
is in the config. The temporary layer goes when coupled training begins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from learner.network.mtrnn import run_levels
from learner.network.vision_input import vision_input
from learner.network.vmdnn import VMDNN
from learner.training.augmentation import disturbed
from learner.training.loss import kl_divergence
from proto.config import PretrainingConfig
from proto.episode import Episode, Image

Classes = Mapping[str, tuple[float, ...]]
"""Centres of the classes, by name of the situation's value."""


def classes_of(episodes: Sequence[Episode], labels: Mapping[str, int]) -> Classes:
    """As many classes for each value as `labels` says, evenly over the episodes' situations."""
    return {
        name: _spread([episode.situation[name] for episode in episodes], count)
        for name, count in labels.items()
    }


class Pretraining:
    """Sequences, classifier and loss of pre-training.

    Attributes:
        classes: centres of the classes.
        classifier: the temporary layer, PFC to all classes.
        parameters: what is trained: V_F, V_S, what enters the PFC and its recurrence, classifier.
    """

    def __init__(
        self,
        network: VMDNN,
        classes: Classes,
        config: PretrainingConfig,
        generator: torch.Generator,
    ) -> None:
        """Put the temporary layer on the network.

        Args:
            network: the network whose vision is to be formed.
            classes: what is asked for; not empty.
            config: when the answer is asked for, and how pictures are disturbed.
            generator: draws the temporary layer's weights and the disturbance.
        """
        self.classes = classes
        self._network = network
        self._config = config
        self._generator = generator
        self._images: list[Image] = []
        self._labels: list[NDArray[np.float32]] = []
        self._counts = [len(centres) for centres in classes.values()]
        self.classifier = nn.Linear(network.pfc.units, sum(self._counts))
        with torch.no_grad():
            for parameter in self.classifier.parameters():
                parameter.uniform_(-1, 1, generator=generator)
        trained = (*network.vision(), network.pfc, self.classifier)
        self.parameters = [
            parameter
            for module in trained
            for parameter in module.parameters()
            if parameter is not network.pfc.feedback
        ]

    def __len__(self) -> int:
        return len(self._images)

    def add(self, episode: Episode) -> None:
        """Take a sequence in; a situation outside the classes counts as the nearest one."""
        labels = [
            soft_label(episode.situation[name], centres) for name, centres in self.classes.items()
        ]
        self._labels.append(np.concatenate(labels))
        self._images.append(episode.images)

    def add_gradients(self, chosen: Tensor) -> float:
        """`loss`; its gradients are added to the parameters' `grad`."""
        loss = self.loss(chosen)
        loss.backward()  # type: ignore[no-untyped-call]
        return loss.item()

    def loss(self, chosen: Tensor) -> Tensor:
        """Mean divergence of the answers to the labels, for the sequences with these indices."""
        indices = chosen.tolist()
        images = [self._images[index] for index in indices]
        labels = torch.from_numpy(np.stack([self._labels[index] for index in indices]))
        answers = self.classifier(run_levels([self._network.pfc], self._see(images), "bottom_up"))
        asked = self._asked([len(image) for image in images])
        losses = [
            kl_divergence(
                functional.log_softmax(answer, dim=-1).unsqueeze(2), label[:, None, None], asked
            )
            for answer, label in zip(
                torch.split(answers, self._counts, dim=-1),
                torch.split(labels, self._counts, dim=-1),
                strict=True,
            )
        ]
        return torch.stack(losses).mean()

    def _see(self, images: Sequence[Image]) -> Tensor:
        """V_S (B, T, units) for pictures of any lengths T; filled up at the end with black."""
        grey = nn.utils.rnn.pad_sequence([torch.from_numpy(each) for each in images], True)
        seen = torch.from_numpy(vision_input(grey.numpy()))
        return self._network.see(disturbed(seen, self._config, self._generator))

    def _asked(self, lengths: Sequence[int]) -> Tensor:
        """(B, T) one in the last part of each sequence, where the answer is asked for."""
        steps = torch.arange(max(lengths))
        ends = torch.tensor(lengths)[:, None]
        starts = (ends * (1 - self._config.answer_part)).floor()
        return ((steps >= starts) & (steps < ends)).float()


def soft_label(value: float, centres: Sequence[float]) -> NDArray[np.float32]:
    """(classes,) all on the class whose centre `value` is, shared between two in between."""
    shares = [np.interp(value, centres, only) for only in np.eye(len(centres))]
    return np.asarray(shares, np.float32)


def _spread(values: Sequence[float], count: int) -> tuple[float, ...]:
    low, high = min(values), max(values)
    centres = np.linspace(low, max(high, low + 1e-6), count)  # centres must differ
    return tuple(centres.tolist())
