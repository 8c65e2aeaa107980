"""Pre-training of the vision as a delayed-response classifier (paper, section 3.3).

The network watches a whole sequence. In a window of it, by default its end, it is asked about the
situation, through a temporary softmax layer on the PFC. The task says what is asked and when. The
temporary layer is dropped when coupled training begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from learner.checkpoint import Classes
from learner.network.mtrnn import run_levels
from learner.network.vision_input import vision_input
from learner.network.vmdnn import VMDNN
from learner.training.augmentation import disturbed
from learner.training.loss import kl_divergence
from proto.config import PretrainingConfig
from proto.episode import Episode, Image
from proto.errors import UserError
from proto.variables import Question, Value


@dataclass(frozen=True)
class Asked:
    """What is asked about a variable.

    Attributes:
        variable: its name.
        classes: the classes of the answer.
        window: in which part of a sequence, see `proto.variables.Question`.
    """

    variable: str
    classes: Classes
    window: tuple[float, float]


def classes_of(episodes: Sequence[Episode], questions: Sequence[Question]) -> dict[str, Classes]:
    """The classes of each question's answer, from the episodes' situations.

    Centres of classes are spread evenly over the values of a continuous variable; the classes of a
    discrete one are its choices.
    """
    classes: dict[str, Classes] = {}
    for question in questions:
        values = [episode.situation[question.variable] for episode in episodes]
        numbers = [value for value in values if not isinstance(value, str)]
        if question.classes is None:
            classes[question.variable] = tuple(sorted({str(value) for value in values}))
        else:
            classes[question.variable] = _spread(numbers, question.classes)
    return classes


class Pretraining:
    """Sequences, classifier and loss of pre-training.

    Attributes:
        asked: what is asked for, in the order of the temporary layer's outputs.
        classifier: the temporary layer, PFC to all classes.
        parameters: what is trained: V_F, V_S, what enters the PFC and its recurrence, classifier.
    """

    def __init__(
        self,
        network: VMDNN,
        asked: Sequence[Asked],
        config: PretrainingConfig,
        generator: torch.Generator,
    ) -> None:
        """Put the temporary layer on the network.

        Args:
            network: the network whose vision is to be formed.
            asked: what is asked for; not empty.
            config: how pictures are disturbed.
            generator: draws the temporary layer's weights and the disturbance.
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
        """Take a sequence in; a situation outside the classes counts as the nearest one."""
        labels = [soft_label(episode.situation[each.variable], each.classes) for each in self.asked]
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
        lengths = [len(image) for image in images]
        losses = [
            kl_divergence(
                functional.log_softmax(answer, dim=-1).unsqueeze(2),
                label[:, None, None],
                in_window(lengths, each.window),
            )
            for answer, label, each in zip(
                torch.split(answers, self._counts, dim=-1),
                torch.split(labels, self._counts, dim=-1),
                self.asked,
                strict=True,
            )
        ]
        return torch.stack(losses).mean()

    def _see(self, images: Sequence[Image]) -> Tensor:
        """V_S (B, T, units) for pictures of any lengths T; filled up at the end with black."""
        grey = nn.utils.rnn.pad_sequence([torch.from_numpy(each) for each in images], True)
        seen = torch.from_numpy(vision_input(grey.numpy()))
        return self._network.see(disturbed(seen, self._config, self._generator))


def in_window(lengths: Sequence[int], window: tuple[float, float]) -> Tensor:
    """(B, T) one in the window of each sequence, where the answer is asked for."""
    steps = torch.arange(max(lengths))
    whole = torch.tensor(lengths)[:, None]
    first, last = ((whole * share).floor() for share in window)
    return ((steps >= first) & (steps < last)).float()


def soft_label(value: Value, classes: Classes) -> NDArray[np.float32]:
    """Label (classes,) of a value: one for its class; between two centres it is shared.

    Raises:
        UserError: a choice that is none of the classes.
    """
    if isinstance(value, str):
        if value not in classes:
            raise UserError(
                f"pre-training knows the choices {', '.join(map(str, classes))}, not {value!r}"
            )
        return np.array([value == each for each in classes], np.float32)
    shares = [np.interp(value, np.asarray(classes, float), only) for only in np.eye(len(classes))]
    return np.asarray(shares, np.float32)


def _spread(values: Sequence[float], count: int) -> tuple[float, ...]:
    low, high = min(values), max(values)
    centres = np.linspace(low, max(high, low + 1e-6), count)  # centres must differ
    return tuple(centres.tolist())
