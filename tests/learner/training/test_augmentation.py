"""Augmentation shifts all images of a sequence alike, and each sequence differently."""

from __future__ import annotations

import torch

from learner.training.augmentation import augment
from proto.config import PretrainingConfig


def test_augmented_images_are_shifted_whole_and_differ_between_sequences() -> None:
    images = torch.rand(6, 5, 12, 16)
    config = PretrainingConfig(image_shift=2, image_gain=0, image_noise=0)
    shifts = []
    after_all = augment(images, config, torch.Generator().manual_seed(1))
    for before, after in zip(images, after_all, strict=True):
        fits = [
            (down, right)
            for down in range(-2, 3)
            for right in range(-2, 3)
            if torch.equal(
                after[:, 2:-2, 2:-2], before[:, 2 + down : 10 + down, 2 + right : 14 + right]
            )
        ]
        assert len(fits) == 1
        shifts += fits
    assert len(set(shifts)) > 1


def test_amplitudes_of_zero_change_nothing() -> None:
    images = torch.rand(2, 5, 12, 16)
    config = PretrainingConfig(image_shift=0, image_gain=0, image_noise=0)
    assert torch.equal(augment(images, config, torch.Generator()), images)
