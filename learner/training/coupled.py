"""Coupled training of PFC, M_S, M_F and M_O on tutored sequences (paper, section 3.3).

The pre-trained vision does not change any more and gets nothing from above, so what it makes of a
sequence is computed once, when the sequence comes in.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from learner.network.softmax_code import SoftmaxCode
from learner.network.vision_input import vision_input
from learner.network.vmdnn import VMDNN
from learner.training.divergence import add_gradients
from learner.training.interpolation import Cells, mixed
from learner.training.sequences import Sequences
from proto.body import ACTION_NAMES
from proto.config import LearnerConfig
from proto.episode import Episode, Floats
from proto.variables import Situation

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Material:
    """All sequences side by side.

    Attributes:
        sequences: what is seen and the teacher's outputs.
        spread: (V_S units,) standard deviation of what each unit sees.
        targets: (S, T, 11) float32, the teacher's actions.
        cells: whose situations are beside each other.
    """

    sequences: Sequences
    spread: Tensor
    targets: Tensor
    cells: Cells


class CoupledTraining:
    """Sequences and loss of coupled training.

    Attributes:
        code: how the outputs code actions; fixed, so that all policies of a run agree.
        parameters: what is trained: everything but the vision.
    """

    def __init__(
        self, network: VMDNN, code: SoftmaxCode, config: LearnerConfig, generator: torch.Generator
    ) -> None:
        """Begin without sequences.

        Args:
            network: the network, of which the vision stays as it is.
            code: how the outputs code actions.
            config: how V_S is disturbed, and how often sequences are mixed.
            generator: draws both.
        """
        self.code = code
        self.parameters = network.coupled_parameters()
        self._network = network
        self._config = config
        self._generator = generator
        self._situations: list[Situation] = []
        self._seen: list[Tensor] = []
        self._codes: list[Tensor] = []
        self._targets: list[Floats] = []
        self._material: _Material | None = None

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
        self._situations.append(episode.situation)
        self._material = None

    def add_gradients(self, chosen: Tensor) -> float:
        """Mean divergence of eq. (5), for the sequences with these indices; adds its gradients."""
        material = self._all()
        shift = self._wrongly(len(chosen), material.spread)
        sequences, share = material.sequences, self._config.interpolation
        if share:
            mixtures = material.cells.mixtures(chosen, share, self._generator)
            sequences = mixed(mixtures, sequences, material.targets, self.code)
            chosen = torch.arange(len(chosen))
        return add_gradients(self._network, sequences, chosen, shift)

    def _all(self) -> _Material:
        """Everything taken in, side by side."""
        if self._material is None:
            sequences = Sequences.stacked(self._seen, self._codes)
            self._material = _Material(
                sequences,
                spread=sequences.seen.std((0, 1)),
                targets=pad_sequence(list(map(torch.from_numpy, self._targets)), True),
                cells=Cells(self._situations, list(map(len, self._seen))),
            )
        return self._material

    def _wrongly(self, count: int, spread: Tensor) -> Tensor | None:
        """How wrongly V_S sees some sequences, each in one way from its start to its end.

        The network so learns not to rely on small differences in what it sees.
        """
        if self._config.vision_noise == 0:
            return None
        wrong = torch.randn(count, len(spread), generator=self._generator)
        return self._config.vision_noise * spread * wrong

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
