"""Clips from a user's videos."""

import cv2
import numpy as np
import pytest

from sim_assets.gestures.clip import FRAMES, SIDES, SIZE
from sim_assets.gestures.videos import GestureVideoError, RecordedGestures, read_clip


def write_video(path, frames, size=(160, 120)):
    """A video that brightens steadily, and whose left half is black."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, size)
    assert writer.isOpened()
    for number in range(frames):
        picture = np.zeros((size[1], size[0], 3), np.uint8)
        picture[:, size[0] // 2 :] = 40 + 160 * number / (frames - 1)
        writer.write(picture)
    writer.release()
    return path


@pytest.fixture
def folder(tmp_path):
    for side in SIDES:
        for name in ("b.avi", "a.avi"):
            write_video(tmp_path / side / name, 20 if name == "a.avi" else 90)
    return tmp_path


@pytest.mark.parametrize("frames", [8, 40, 173])
@pytest.mark.parametrize("size", [(160, 120), (48, 64), (96, 96)])
def test_videos_of_any_length_and_size_become_clips(tmp_path, frames, size):
    clip = read_clip(write_video(tmp_path / "v.avi", frames, size))
    assert clip.shape == (FRAMES, SIZE, SIZE)
    assert clip.dtype == np.uint8
    assert clip[:, :, : SIZE // 2 - 8].max() < 16
    brightness = clip[:, :, SIZE // 2 + 8 :].mean(axis=(1, 2))
    np.testing.assert_allclose(brightness, np.linspace(40, 200, FRAMES), atol=16)


def test_a_folder_lists_its_takes_by_name(folder):
    (folder / "picture-left" / ".hidden").write_text("not a video")
    library = RecordedGestures(folder)
    assert library.subjects == ("recorded",)
    assert library.takes == ("0", "1")
    np.testing.assert_array_equal(
        library.clip("picture-left", "recorded", "0"),
        read_clip(folder / "picture-left" / "a.avi"),
    )


def test_takes_are_those_that_exist_for_both_sides(folder):
    (folder / "picture-right" / "b.avi").unlink()
    assert RecordedGestures(folder).takes == ("0",)


def test_unknown_names_are_refused(folder):
    library = RecordedGestures(folder)
    for subject, take in (("0", "0"), ("recorded", "2")):
        with pytest.raises(ValueError, match=f"got subject '{subject}', take '{take}'"):
            library.clip("picture-left", subject, take)


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(GestureVideoError, match=r"nowhere: there is no such folder"):
        RecordedGestures(tmp_path / "nowhere")


def test_a_missing_or_empty_side_is_refused(folder):
    side = folder / "picture-right"
    for path in side.iterdir():
        path.unlink()
    with pytest.raises(GestureVideoError, match="picture-right: holds no video"):
        RecordedGestures(folder)
    side.rmdir()
    with pytest.raises(GestureVideoError, match="no subfolder picture-right"):
        RecordedGestures(folder)


def test_a_file_that_is_not_a_video_is_refused(folder):
    bad = folder / "picture-left" / "notes.txt"
    bad.write_text("to do: film the left side")
    with pytest.raises(GestureVideoError, match=r"notes\.txt: cannot be read as a video"):
        RecordedGestures(folder)


def test_a_video_that_is_too_short_is_refused(folder):
    write_video(folder / "picture-left" / "short.avi", 7)
    with pytest.raises(GestureVideoError, match=r"short\.avi: has 7 frames.* at least 8"):
        RecordedGestures(folder)
