"""The loss that training minimizes."""

from __future__ import annotations

import torch
from torch import Tensor


def kl_divergence(log_outputs: Tensor, targets: Tensor, mask: Tensor) -> Tensor:
    """Kullback-Leibler divergence of eq. (5), averaged over the steps in the mask and the values.

    Eq. (5) is a sum. The mean differs from it by a factor only, and makes learning rate and
    gradient clipping independent of the length of the sequences. Up to that factor, the gradient
    by the potentials of M_O is y - y_bar; eq. (6) prints the negative.

    Args:
        log_outputs: (B, T, values, units) logarithms of the outputs y.
        targets: (B, T, values, units) the teacher's outputs y_bar; broadcasts.
        mask: (B, T) one where a sequence has a step, zero in its padding.
    """
    divergence = (torch.xlogy(targets, targets) - targets * log_outputs).sum((-1, -2))
    return (divergence * mask).sum() / (mask.sum() * log_outputs.shape[-2])
