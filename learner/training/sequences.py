"""Tutored sequences side by side, as coupled training reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence


@dataclass(frozen=True)
class Sequences:
    """All sequences, filled up with zeros to the longest.

    Attributes:
        seen: (S, T, V_S units) activity of V_S.
        codes: (S, T, values, softmax units) the teacher's outputs; those of a value sum to one.
        mask: (S, T) one where a sequence has a step.
        code_entropies: (S, T) sum of codes * log(codes), the part of the divergence that no
            network changes.
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
        """Sequences that are filled up already."""
        return cls(seen, codes, mask, torch.xlogy(codes, codes).sum((-1, -2)))

    def to(self, device: torch.device) -> Self:
        """The same on another device."""
        return type(self)(*(tensor.to(device) for tensor in vars(self).values()))
