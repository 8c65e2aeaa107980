"""Disturbance of pictures, so that few situations are not learned by heart."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from proto.config import PretrainingConfig, RivalConfig


def disturbed(
    images: Tensor, config: PretrainingConfig | RivalConfig, generator: torch.Generator
) -> Tensor:
    """Images (B, T, H, W), those of each sequence shifted, brightened and with noise.

    Args:
        images: brightness -1..1.
        config: how much, in `image_shift`, `image_gain` and `image_noise`.
        generator: draws it, anew in each call.
    """
    batch, _, height, width = images.shape
    reach = config.image_shift
    padded = functional.pad(images, (reach,) * 4, mode="replicate")
    corners = torch.randint(2 * reach + 1, (batch, 2), generator=generator).tolist()
    shifted = torch.stack(
        [
            one[:, top : top + height, left : left + width]
            for one, (top, left) in zip(padded, corners, strict=True)
        ]
    )
    gain, offset = config.image_gain * torch.randn(2, batch, 1, 1, 1, generator=generator)
    noise = config.image_noise * torch.randn(shifted.shape, generator=generator)
    result: Tensor = shifted * (1 + gain) + offset + noise
    return result
