"""The cameras and pictures that all backends share."""

from __future__ import annotations

import numpy as np
import pytest

from actors.backends import eye
from actors.simulator import Crop


def test_a_crop_has_a_longer_focal_length():
    whole = eye.eye_focal_lengths(Crop(), 320, 240)
    assert whole == pytest.approx((257.34, 257.34), abs=0.01)  # the iCub's camera
    assert eye.eye_focal_lengths(Crop(160, 120), 320, 240) == pytest.approx((514.68, 514.68), 1e-4)


def test_the_outside_camera_looks_at_its_target():
    pose = eye.outside_pose()
    forward, left, up = pose[:3, :3].T
    towards = np.subtract(eye.OUTSIDE_TARGET_M, pose[:3, 3])
    assert forward == pytest.approx(towards / np.linalg.norm(towards))
    assert np.cross(forward, left) == pytest.approx(up)
    assert left[2] == pytest.approx(0.0)
    assert up[2] > 0


def rendered(colour: tuple[int, int, int, int]) -> np.ndarray:
    width, height = eye.SUPERSAMPLED_SIZE
    return np.full((height, width, 4), colour, dtype=np.uint8)


def test_sky_is_grey_where_no_body_is_seen():
    nothing = rendered((0, 0, 0, 0))
    assert np.unique(eye.grey(nothing)) == eye.SKY
    assert np.unique(eye.colours(nothing)) == eye.SKY


def test_a_body_is_seen_in_its_own_colour_and_grey():
    body = rendered((200, 100, 50, 255))
    assert eye.colours(body)[0, 0].tolist() == [200, 100, 50]
    assert np.unique(eye.grey(body)) == round(0.299 * 200 + 0.587 * 100 + 0.114 * 50)


def test_the_networks_picture_averages_blocks_of_pixels():
    fine = rendered((0, 0, 0, 255))
    fine[:3, :3, :3] = 9 * np.arange(9, dtype=np.uint8).reshape(3, 3)[..., None]
    picture = eye.grey(fine)
    assert picture.shape == eye.black().shape == (48, 64)
    assert picture[0, 0] == 36
    assert not picture[0, 1:].any()
