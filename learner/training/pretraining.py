"""Pre-training of the vision as a delayed-response classifier (paper, section 3.3).

The network watches a whole sequence. At its end a temporary softmax layer on the PFC classifies
the situation: where the object is and how it lies. The config names the values and the number of
classes of each. The temporary layer is dropped when coupled training begins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from learner.network.mtrnn import run_levels
from learner.network.softmax_code import SoftmaxCode
from learner.network.vmdnn import VMDNN
from learner.training.augmentation import augmented_input
from learner.training.divergence import backward
from learner.training.loss import kl_divergence
from proto.config import PretrainingConfig
from proto.episode import Episode, Image

Classes = Mapping[str, tuple[float, ...]]
"""Centres of the classes, by name of a value of the situation."""


def classes_of(episodes: Sequence[Episode], labels: Mapping[str, int]) -> Classes:
    """Classes that cover the episodes' situations evenly.

    Args:
        episodes: not empty.
        labels: number of classes by name of the situation's value.
    """
    return {
        name: _centres([episode.situation[name] for episode in episodes], count)
        for name, count in labels.items()
    }


class Pretraining:
    """Objective of pre-training: classification of sequences.

    Attributes:
        code: always None; the network cannot act yet.
        classes: centres of the classes.
        classifier: the temporary layer, from the PFC to all classes.
        parameters: what is trained: V_F, V_S, the PFC without feedback, and the classifier.
    """

    code: SoftmaxCode | None = None

    def __init__(
        self,
        network: VMDNN,
        classes: Classes,
        config: PretrainingConfig,
        generator: torch.Generator,
    ) -> None:
        """Put the temporary layer on the network; start without sequences.

        Args:
            network: the network; its vision and PFC are trained.
            classes: the classes; not empty.
            config: in which part of a sequence it is classified, and how images are augmented.
            generator: draws the temporary layer's weights and the augmentation.
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
        """Add a sequence; a value outside the classes is learned as the outermost class."""
        labels = [
            soft_label(episode.situation[name], centres) for name, centres in self.classes.items()
        ]
        self._labels.append(np.concatenate(labels))
        self._images.append(episode.images)

    def add_gradients(self, chosen: Tensor) -> float:
        """`loss`; adds its gradients to the parameters' `grad`."""
        return backward(self.loss(chosen))

    def loss(self, chosen: Tensor) -> Tensor:
        """Mean divergence of classifier and labels, for the sequences with these indices."""
        indices = chosen.tolist()
        images = [self._images[index] for index in indices]
        labels = torch.from_numpy(np.stack([self._labels[index] for index in indices]))
        seen = self._network.see(augmented_input(images, self._config, self._generator))
        answers = self.classifier(run_levels([self._network.pfc], seen, "bottom_up"))
        mask = self._answer_mask([len(image) for image in images])
        losses = [
            kl_divergence(
                functional.log_softmax(answer, dim=-1).unsqueeze(2), label[:, None, None], mask
            )
            for answer, label in zip(
                torch.split(answers, self._counts, dim=-1),
                torch.split(labels, self._counts, dim=-1),
                strict=True,
            )
        ]
        return torch.stack(losses).mean()

    def _answer_mask(self, lengths: Sequence[int]) -> Tensor:
        """(B, T) one in the last part of each sequence, where it is classified."""
        steps = torch.arange(max(lengths))
        ends = torch.tensor(lengths)[:, None]
        starts = (ends * (1 - self._config.answer_part)).floor()
        return ((steps >= starts) & (steps < ends)).float()


def soft_label(value: float, centres: Sequence[float]) -> NDArray[np.float32]:
    """(classes,) one for the class with this centre; between two centres, shared by both."""
    shares = [np.interp(value, centres, only) for only in np.eye(len(centres))]
    return np.asarray(shares, np.float32)


def _centres(values: Sequence[float], count: int) -> tuple[float, ...]:
    """Centres of classes, evenly from the lowest to the highest value."""
    low, high = min(values), max(values)
    centres = np.linspace(low, max(high, low + 1e-6), count)  # centres must differ
    return tuple(centres.tolist())
