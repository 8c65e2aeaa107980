"""Coupled training of PFC, M_S, M_F and M_O on tutored sequences (paper, section 3.3).

The pre-trained vision stays as it is and gets no input from above, so V_S is computed once for each
sequence, when the sequence is added.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from learner.network.softmax_code import SoftmaxCode
from learner.network.vision_input import vision_input
from learner.network.vmdnn import VMDNN
from learner.training.asked import Asked
from learner.training.divergence import add_gradients
from learner.training.interpolation import NeighbourGrid, mix_sequences
from learner.training.sequences import Minibatch, Sequences
from proto.body import ACTION_NAMES
from proto.config import LearnerConfig
from proto.episode import Episode, Floats
from proto.variables import Situation

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Stacked:
    """All sequences side by side.

    Attributes:
        sequences: what is seen, and the teacher's outputs.
        deviations: (V_S units,) standard deviation of each unit's activity.
        targets: (S, T, 11) float32, the teacher's actions.
        grid: which situations are neighbours.
    """

    sequences: Sequences
    deviations: Tensor
    targets: Tensor
    grid: NeighbourGrid


class CoupledObjective:
    """What objectives of coupled training have in common: sequences as a fixed vision sees them.

    Attributes:
        code: how the outputs code actions; fixed, so that all policies of a run agree.
        asked: always empty.
        classifier: always None.
    """

    asked: Sequence[Asked] = ()
    classifier = None

    def __init__(
        self,
        see: Callable[[Tensor], Tensor],
        code: SoftmaxCode,
        generator: torch.Generator,
        distractors: Collection[str] = (),
    ) -> None:
        """Start without sequences.

        Args:
            see: V_S (B, T, units) for images (B, T, height, width).
            code: how the outputs code actions.
            generator: draws noise and mixtures.
            distractors: variables that the actions do not depend on, see `NeighbourGrid`.
        """
        self._distractors = distractors
        self.code = code
        self._see = see
        self._generator = generator
        self._situations: list[Situation] = []
        self._seen: list[Tensor] = []
        self._codes: list[Tensor] = []
        self._targets: list[Floats] = []
        self._stacked: _Stacked | None = None

    def __len__(self) -> int:
        return len(self._seen)

    def add(self, episode: Episode) -> None:
        """Add a sequence; targets outside the code's ranges are learned as the ranges' ends."""
        self._warn_outside(episode)
        images = torch.from_numpy(vision_input(episode.images))
        with torch.no_grad():
            self._seen.append(self._see(images[None])[0])
        self._codes.append(torch.from_numpy(self.code.encode(episode.targets)))
        self._targets.append(episode.targets)
        self._situations.append(episode.situation)
        self._stacked = None

    def sequences(self) -> Sequences:
        """All sequences side by side."""
        return self._all().sequences

    def mixed(self, chosen: Tensor, share: float) -> Sequences:
        """The sequences with these indices, a share of them mixed with their neighbours."""
        stacked = self._all()
        mixtures = stacked.grid.mixtures(chosen, share, self._generator)
        return mix_sequences(mixtures, stacked.sequences, stacked.targets, self.code)

    def vision_noise(self, count: int, amplitude: float) -> Tensor:
        """Noise (count, units) added to V_S, constant through a sequence.

        It keeps the network from relying on small differences in what it sees.

        Args:
            count: number of sequences.
            amplitude: in standard deviations of each unit's activity.
        """
        deviations = self._all().deviations
        noise = torch.randn(count, len(deviations), generator=self._generator)
        return amplitude * deviations * noise

    def _all(self) -> _Stacked:
        if self._stacked is None:
            sequences = Sequences.stacked(self._seen, self._codes)
            self._stacked = _Stacked(
                sequences,
                deviations=sequences.seen.std((0, 1)),
                targets=pad_sequence(list(map(torch.from_numpy, self._targets)), True),
                grid=NeighbourGrid(self._situations, list(map(len, self._seen)), self._distractors),
            )
        return self._stacked

    def _warn_outside(self, episode: Episode) -> None:
        excess = np.maximum(self.code.minima - episode.targets, episode.targets - self.code.maxima)
        for name, amount in zip(ACTION_NAMES, excess.max(0), strict=True):
            if amount > 1e-3:
                _log.warning(
                    "sequence %s: %s goes %.2f beyond the range that was fixed when coupled"
                    " training began; it is learned as the end of that range",
                    episode.id,
                    name,
                    amount,
                )


class CoupledTraining(CoupledObjective):
    """Objective of VMDNN in coupled training: eq. (5) on tutored sequences and mixtures of them.

    Attributes:
        parameters: what is trained: everything but the vision.
    """

    def __init__(
        self,
        network: VMDNN,
        code: SoftmaxCode,
        config: LearnerConfig,
        generator: torch.Generator,
        distractors: Collection[str] = (),
    ) -> None:
        """Start without sequences.

        Args:
            network: the network; its vision stays as it is.
            code: how the outputs code actions.
            config: amplitude of the vision noise, and how often sequences are mixed.
            generator: draws both.
            distractors: variables that the actions do not depend on, see `NeighbourGrid`.
        """
        super().__init__(network.see, code, generator, distractors)
        self.parameters = network.coupled_parameters()
        self._network = network
        self._config = config

    def add_gradients(self, chosen: Tensor) -> float:
        """Mean divergence of eq. (5), for the sequences with these indices; adds its gradients."""
        amplitude, share = self._config.vision_noise, self._config.interpolation
        noise = self.vision_noise(len(chosen), amplitude) if amplitude else None
        if share:
            minibatch = Minibatch.of_all(self.mixed(chosen, share), noise)
        else:
            minibatch = Minibatch(self.sequences(), chosen, shift=noise)
        return add_gradients(self._network, minibatch)

    def mean_errors(self) -> NDArray[np.float64]:
        """(11,) mean distance of the decoded outputs from the targets, over all sequences.

        The network sees the tutor's images, not those that its own actions would lead to.
        """
        errors = []
        with torch.no_grad():
            for seen, targets in zip(self._seen, self._targets, strict=True):
                outputs = self._network.act(seen[None])[0].exp().numpy()
                errors.append(np.abs(self.code.decode(outputs) - targets))
        return np.asarray(np.concatenate(errors).mean(0))
