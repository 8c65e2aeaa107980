"""Drawn clips are seeded and different, and their sides can be recognized."""

import cv2
import numpy as np
import pytest

from sim_assets.gestures.clip import FRAMES, SIDES, SIZE
from sim_assets.gestures.drawing import DrawnGestures, draw_clip
from sim_assets.gestures.subject import Sleeve, Subject
from sim_assets.gestures.take import Take

COARSE = {
    ("picture-left", 0, 0): [[177, 160, 180, 182], [152, 64, 122, 182], [176, 112, 152, 182]],
    ("picture-right", 5, 2): [[170, 169, 174, 179], [170, 114, 120, 173], [170, 122, 137, 178]],
}
"""Mean grey levels (3, 4) of clips by side, subject and take."""


def coarse(clip):
    """Mean pictures (3, 4) of the whole clip in coarse squares, which tolerate other rounding."""
    return cv2.resize(clip.mean(axis=0), (4, 3), interpolation=cv2.INTER_AREA)


def raised_arm(clip):
    """How many pixels the raised arm darkens in the left and the right quarter."""
    hanging, pointing = clip[0].astype(float), np.median(clip[16:26], axis=0)
    darkened = hanging - pointing > 25.0
    return darkened[:, : SIZE // 4].sum(), darkened[:, -SIZE // 4 :].sum()


def test_a_clip_is_forty_grey_pictures():
    clip = draw_clip("picture-left", Subject.from_seed(0), 0)
    assert clip.shape == (FRAMES, SIZE, SIZE) == (40, 96, 96)
    assert clip.dtype == np.uint8


@pytest.mark.parametrize(("side", "subject", "take"), COARSE)
def test_a_seed_gives_the_same_clip_on_every_machine(side, subject, take):
    clip = draw_clip(side, Subject.from_seed(subject), take)
    np.testing.assert_array_equal(clip, draw_clip(side, Subject.from_seed(subject), take))
    np.testing.assert_allclose(coarse(clip), COARSE[side, subject, take], atol=2.0)


@pytest.mark.parametrize("seed", range(8))
def test_the_arm_appears_on_the_side_that_is_pointed_at(seed):
    subject = Subject.from_seed(seed)
    for take in range(3):
        left, right = raised_arm(draw_clip("picture-left", subject, take))
        assert left > 2 * right
        left, right = raised_arm(draw_clip("picture-right", subject, take))
        assert right > 2 * left


def test_clothes_and_skin_are_darker_than_the_wall():
    for subject in map(Subject.from_seed, range(200)):
        darkest_wall = subject.wall - abs(subject.wall_slope)
        for grey in (subject.skin, subject.hair, subject.shirt, subject.trousers):
            assert grey < darkest_wall


def test_subjects_differ():
    subjects = [Subject.from_seed(seed) for seed in range(50)]
    assert {subject.sleeve for subject in subjects} == set(Sleeve)
    assert {subject.long_hair for subject in subjects} == {False, True}
    for name in ("height_m", "girth", "shirt", "wall"):
        assert len({getattr(subject, name) for subject in subjects}) == 50


def test_takes_of_one_subject_differ_and_sides_do_not_mirror_each_other():
    takes = [Take.from_seeds(side, 3, take) for side in SIDES for take in range(10)]
    assert len({take.onset for take in takes}) == 20
    subject = Subject.from_seed(3)
    first, second = draw_clip("picture-left", subject, 0), draw_clip("picture-left", subject, 1)
    assert np.abs(first.astype(int) - second).mean() > 2.0


def test_the_arm_rises_once_and_stays_within_its_range():
    for seed in range(100):
        take = Take.from_seeds("picture-right", 0, seed)
        raised = np.array([take.raised(frame) for frame in range(FRAMES)])
        assert raised[0] == 0.0
        assert raised.max() == 1.0
        assert (raised >= 0.0).all()
        rising = np.diff(raised) > 0
        assert not (np.diff(rising.astype(int)) > 0).sum() > 1


def test_library_lists_its_clips_and_draws_others_too():
    library = DrawnGestures(subjects=2, takes=3)
    assert library.subjects == ("0", "1")
    assert library.takes == ("0", "1", "2")
    np.testing.assert_array_equal(
        library.clip("picture-right", "7", "12"),
        draw_clip("picture-right", Subject.from_seed(7), 12),
    )


@pytest.mark.parametrize("name", ["", "-1", "anna", "1.0", "²"])
def test_library_refuses_other_names(name):
    with pytest.raises(ValueError, match="named 0, 1, 2"):
        DrawnGestures(1, 10).clip("picture-left", name, "0")
    with pytest.raises(ValueError, match="named 0, 1, 2"):
        DrawnGestures(1, 10).clip("picture-left", "0", name)
