"""Pre-training of the vision as a delayed-response classifier (paper, section 3.3).

The network watches a whole sequence. In a window of it, by default at its end, a temporary softmax
layer on the PFC classifies the situation. The task says which variables are asked for, and when.
The temporary layer is dropped when coupled training begins.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from learner.network.mtrnn import run_levels
from learner.network.softmax_code import SoftmaxCode
from learner.network.vmdnn import VMDNN
from learner.training.asked import Asked, soft_label
from learner.training.augmentation import augmented_input
from learner.training.divergence import backward
from learner.training.loss import kl_divergence
from proto.config import PretrainingConfig
from proto.episode import Episode, Image


class Pretraining:
    """Objective of pre-training: classification of sequences.

    Attributes:
        code: always None; the network cannot act yet.
        asked: what is asked for, in the order of the classifier's outputs.
        classifier: the temporary layer, from the PFC to all classes.
        parameters: what is trained: V_F, V_S, the PFC without feedback, and the classifier.
    """

    code: SoftmaxCode | None = None

    def __init__(
        self,
        network: VMDNN,
        asked: Sequence[Asked],
        config: PretrainingConfig,
        generator: torch.Generator,
    ) -> None:
        """Put the temporary layer on the network; start without sequences.

        Args:
            network: the network; its vision and PFC are trained.
            asked: what is asked for; not empty.
            config: how images are augmented.
            generator: draws the temporary layer's weights and the augmentation.
        """
        self.asked = tuple(asked)
        self._network = network
        self._config = config
        self._generator = generator
        self._images: list[Image] = []
        self._labels: list[NDArray[np.float32]] = []
        self._counts = [len(each.classes) for each in asked]
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
        """Add a sequence; a number outside the classes is learned as the outermost class.

        Raises:
            UserError: a choice that is none of the classes.
        """
        labels = [soft_label(episode.situation[each.variable], each.classes) for each in self.asked]
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
        lengths = [len(image) for image in images]
        losses = [
            kl_divergence(
                functional.log_softmax(answer, dim=-1).unsqueeze(2),
                label[:, None, None],
                window_mask(lengths, each.window),
            )
            for answer, label, each in zip(
                torch.split(answers, self._counts, dim=-1),
                torch.split(labels, self._counts, dim=-1),
                self.asked,
                strict=True,
            )
        ]
        return torch.stack(losses).mean()


def window_mask(lengths: Sequence[int], window: tuple[float, float]) -> Tensor:
    """(B, T) one in the window of each sequence; its ends are shares of the sequence's length."""
    steps = torch.arange(max(lengths))
    ends = torch.tensor(lengths)[:, None]
    first, last = ((ends * share).floor() for share in window)
    return ((steps >= first) & (steps < last)).float()
