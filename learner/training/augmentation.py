"""Random changes of images, so that a network does not memorize the few situations it is shown."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from learner.network.vision_input import BRIGHTNESS
from proto.config import PretrainingConfig, RivalConfig
from proto.episode import Image


def augmented_input(
    images: Sequence[Image], config: PretrainingConfig | RivalConfig, generator: torch.Generator
) -> Tensor:
    """Input of the vision (B, T, height, width) for augmented images of B sequences.

    The images of each sequence are shifted alike, their contrast and brightness are changed, and
    noise is added to each pixel. A shift repeats the rows and columns at the sides.

    Args:
        images: grey values (T, height, width) of each sequence; shorter ones are padded with black.
        config: amplitudes `image_shift`, `image_gain` and `image_noise`.
        generator: draws new changes in each call.
    """
    batch, longest = len(images), max(len(each) for each in images)
    height, width = images[0].shape[1:]
    reach = config.image_shift
    corners = torch.randint(2 * reach + 1, (batch, 2), generator=generator).tolist()
    gains, offsets = (config.image_gain * torch.randn(2, batch, generator=generator)).numpy()
    noise = torch.randn(batch, longest, height, width, generator=generator)
    result = noise.mul_(config.image_noise)
    for index, (image, (top, left)) in enumerate(zip(images, corners, strict=True)):
        padded = np.pad(image, ((0, longest - len(image)), (0, 0), (0, 0)))
        padded = np.pad(padded, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
        shifted = padded[:, top : top + height, left : left + width]
        # Bytes have 256 values: looking them up is several times as fast as computing with floats.
        table = BRIGHTNESS * (1 + gains[index]) + offsets[index]
        result[index] += torch.from_numpy(cv2.LUT(shifted.reshape(-1, width), table)).view(
            shifted.shape
        )
    return result
