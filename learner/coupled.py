"""Coupled training of PFC, M_S, M_F and M_O on tutored sequences (paper, section 3.3).

The pre-trained vision does not change any more and gets nothing from above, so what it makes of a
sequence is computed once, when the sequence comes in.
"""

from __future__ import annotations

import logging

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.divergence import divergence
from learner.sequences import Sequences
from learner.softmax_code import SoftmaxCode
from learner.vision_input import vision_input
from learner.vmdnn import VMDNN
from proto.action import ACTION_NAMES
from proto.episode import Episode, Floats

_log = logging.getLogger(__name__)


class CoupledTraining:
    """Sequences and loss of coupled training.

    Attributes:
        code: how the outputs code actions; fixed, so that all policies of a run agree.
        parameters: what is trained: everything but the vision.
    """

    def __init__(
        self, network: VMDNN, code: SoftmaxCode, vision_noise: float, generator: torch.Generator
    ) -> None:
        """Begin without sequences.

        Args:
            network: the network, of which the vision stays as it is.
            code: how the outputs code actions.
            vision_noise: disturbance of V_S, see `LearnerConfig`.
            generator: draws it.
        """
        self.code = code
        self.parameters = network.coupled_parameters()
        self._network = network
        self._vision_noise = vision_noise
        self._generator = generator
        self._seen: list[Tensor] = []
        self._codes: list[Tensor] = []
        self._targets: list[Floats] = []
        self._sequences: Sequences | None = None

    def __len__(self) -> int:
        return len(self._seen)

    def add(self, episode: Episode) -> None:
        """Take a sequence in; targets outside the code's ranges are learned as their ends."""
        self._warn_outside(episode)
        images = torch.from_numpy(vision_input(episode.images))
        with torch.no_grad():
            self._seen.append(self._network.see(images[None])[0])
        self._codes.append(torch.from_numpy(self.code.encode(episode.targets)))
        self._targets.append(episode.targets)
        self._sequences = None

    def loss(self, chosen: Tensor) -> Tensor:
        """Mean divergence of eq. (5), for the sequences with these indices."""
        if self._sequences is None:
            self._sequences = Sequences.stacked(self._seen, self._codes)
            self._spread = self._sequences.seen.std((0, 1))
        return divergence(self._network, self._sequences, chosen, shift=self._wrongly(len(chosen)))

    def _wrongly(self, count: int) -> Tensor | None:
        """How wrongly V_S sees some sequences, each in one way from its start to its end.

        Between the tutored situations the network so sees what it has learned to act on, and
        interpolates instead of snapping to the nearest of them.
        """
        if self._vision_noise == 0:
            return None
        wrong = torch.randn(count, len(self._spread), generator=self._generator)
        return self._vision_noise * self._spread * wrong

    def mean_errors(self) -> NDArray[np.float64]:
        """(11,) mean distance of the decoded outputs from the targets, over all sequences."""
        errors = []
        with torch.no_grad():
            for seen, targets in zip(self._seen, self._targets, strict=True):
                outputs = self._network.act(seen[None])[0].exp().numpy()
                errors.append(np.abs(self.code.decode(outputs) - targets))
        return np.asarray(np.concatenate(errors).mean(0))

    def _warn_outside(self, episode: Episode) -> None:
        excess = np.maximum(self.code.minima - episode.targets, episode.targets - self.code.maxima)
        worst = excess.max(0)
        for name, amount in zip(ACTION_NAMES, worst, strict=True):
            if amount > 1e-3:
                _log.warning(
                    "sequence %s: %s goes %.2f beyond the range that was fixed when coupled"
                    " training began; it is learned as the end of that range",
                    episode.id,
                    name,
                    amount,
                )
