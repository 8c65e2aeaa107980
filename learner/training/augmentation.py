"""Random changes of images, so that a network does not memorize the few situations it is shown."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence

from learner.network.vision_input import vision_input
from proto.config import PretrainingConfig, RivalConfig
from proto.episode import Image


def augmented_input(
    images: Sequence[Image], config: PretrainingConfig | RivalConfig, generator: torch.Generator
) -> Tensor:
    """Input of the vision (B, T, height, width) for augmented images of B sequences.

    Args:
        images: grey values (T, height, width) of each sequence; shorter ones are padded with black.
        config: amplitudes `image_shift`, `image_gain` and `image_noise`.
        generator: draws new changes in each call.
    """
    grey = pad_sequence([torch.from_numpy(each) for each in images], batch_first=True)
    return augment(torch.from_numpy(vision_input(grey.numpy())), config, generator)


def augment(
    images: Tensor, config: PretrainingConfig | RivalConfig, generator: torch.Generator
) -> Tensor:
    """Shift the images of each sequence, change their contrast and brightness, and add noise.

    Args:
        images: (B, T, height, width) brightness -1..1.
        config: amplitudes `image_shift`, `image_gain` and `image_noise`.
        generator: draws new changes in each call.
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
