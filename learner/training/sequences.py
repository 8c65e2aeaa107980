"""Tutored sequences side by side, as coupled training reads them, and minibatches of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from learner.training.loss import kl_divergence


@dataclass(frozen=True)
class Sequences:
    """Sequences, padded with zeros to the longest of them.

    Attributes:
        seen: (S, T, V_S units) activity of V_S.
        codes: (S, T, values, softmax units) the teacher's outputs; those of a value sum to one.
        mask: (S, T) one where a sequence has a step.
        code_entropies: (S, T) sum of codes * log(codes), the part of the divergence that does not
            depend on the network.
    """

    seen: Tensor
    codes: Tensor
    mask: Tensor
    code_entropies: Tensor

    @classmethod
    def stacked(cls, seen: Sequence[Tensor], codes: Sequence[Tensor]) -> Self:
        """Put sequences (T, ...) of any lengths side by side."""
        masks = [one.new_ones(len(one)) for one in seen]
        return cls.of(
            pad_sequence(list(seen), batch_first=True),
            pad_sequence(list(codes), batch_first=True),
            pad_sequence(masks, batch_first=True),
        )

    @classmethod
    def of(cls, seen: Tensor, codes: Tensor, mask: Tensor) -> Self:
        """Sequences that are padded already; computes the entropies."""
        return cls(seen, codes, mask, torch.xlogy(codes, codes).sum((-1, -2)))

    def __len__(self) -> int:
        return len(self.mask)


@dataclass(frozen=True)
class Minibatch:
    """Sequences that one loss is computed of.

    Attributes:
        sequences: all sequences.
        chosen: (B,) int64, indices of those in the minibatch.
        initial: (B, units of PFC, M_S and M_F) potentials before the first step, or None for zero,
            the neutral state.
        shift: (B, V_S units) added to what is seen at every step, or None.
    """

    sequences: Sequences
    chosen: Tensor
    initial: Tensor | None = None
    shift: Tensor | None = None

    @classmethod
    def of_all(cls, sequences: Sequences, shift: Tensor | None = None) -> Self:
        """A minibatch of all sequences."""
        return cls(sequences, torch.arange(len(sequences)), shift=shift)

    def seen(self) -> Tensor:
        """(B, T, V_S units) activity of V_S, with the shift."""
        seen = self.sequences.seen[self.chosen]
        return seen if self.shift is None else seen + self.shift[:, None]

    def divergence(self, log_outputs: Tensor) -> Tensor:
        """Mean divergence of eq. (5) for logarithms (B, T, values, softmax units) of outputs."""
        sequences = self.sequences
        return kl_divergence(log_outputs, sequences.codes[self.chosen], sequences.mask[self.chosen])
