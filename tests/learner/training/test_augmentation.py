"""Augmentation shifts all images of a sequence alike, and each sequence differently."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional

from learner.network.vision_input import vision_input
from learner.training.augmentation import augmented_input
from proto.config import PretrainingConfig
from proto.episode import Image


def some_images(*lengths: int) -> list[Image]:
    generator = np.random.default_rng(1)
    return [generator.integers(256, size=(length, 12, 16), dtype=np.uint8) for length in lengths]


def test_augmented_images_are_shifted_whole_and_differ_between_sequences() -> None:
    images = some_images(5, 5, 5, 5, 5, 5)
    config = PretrainingConfig(image_shift=2, image_gain=0, image_noise=0)
    shifts = []
    after_all = augmented_input(images, config, torch.Generator().manual_seed(1)).numpy()
    for image, after in zip(images, after_all, strict=True):
        before = vision_input(image)
        fits = [
            (down, right)
            for down in range(-2, 3)
            for right in range(-2, 3)
            if np.array_equal(
                after[:, 2:-2, 2:-2], before[:, 2 + down : 10 + down, 2 + right : 14 + right]
            )
        ]
        assert len(fits) == 1
        shifts += fits
    assert len(set(shifts)) > 1


def test_amplitudes_of_zero_change_nothing() -> None:
    images = some_images(5, 3)
    config = PretrainingConfig(image_shift=0, image_gain=0, image_noise=0)
    after = augmented_input(images, config, torch.Generator()).numpy()
    np.testing.assert_array_equal(after[0], vision_input(images[0]))
    np.testing.assert_array_equal(after[1, :3], vision_input(images[1]))
    assert (after[1, 3:] == -1).all(), "black"


@given(
    lengths=st.lists(st.integers(1, 4), min_size=1, max_size=3),
    reach=st.integers(0, 3),
    gain=st.floats(0, 0.5),
    noise=st.floats(0, 0.5),
    seed=st.integers(0, 1000),
)
def test_it_is_the_formula(
    lengths: list[int], reach: int, gain: float, noise: float, seed: int
) -> None:
    images = some_images(*lengths)
    config = PretrainingConfig(image_shift=reach, image_gain=gain, image_noise=noise)
    after = augmented_input(images, config, torch.Generator().manual_seed(seed))

    generator = torch.Generator().manual_seed(seed)
    longest = max(lengths)
    corners = torch.randint(2 * reach + 1, (len(images), 2), generator=generator).tolist()
    factor, offset = gain * torch.randn(2, len(images), 1, 1, 1, generator=generator)
    shifted = []
    for image, (top, left) in zip(images, corners, strict=True):
        whole = np.zeros((longest, 12, 16), np.uint8)
        whole[: len(image)] = image
        padded = functional.pad(torch.from_numpy(vision_input(whole)), (reach,) * 4, "replicate")
        shifted.append(padded[:, top : top + 12, left : left + 16])
    drawn = torch.randn(after.shape, generator=generator)
    assert torch.equal(after, torch.stack(shifted) * (1 + factor) + offset + noise * drawn)
