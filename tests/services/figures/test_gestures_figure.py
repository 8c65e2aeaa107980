"""The contact sheet of gesture clips, from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from services.cli import main
from services.figures import gestures
from sim_assets.gestures.clip import SIDES
from sim_assets.gestures.drawing import DrawnGestures


def test_every_subject_is_shown_for_both_sides(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sheet.png"
    assert main(["figure", "gestures", "--subjects", "3", "--json", "--out", str(out)]) == 0
    clips = json.loads(capsys.readouterr().out)["clips"]
    shown = [(clip["subject"], clip["take"], clip["side"]) for clip in clips]
    assert shown == [(subject, "0", side) for subject in "012" for side in SIDES]
    assert all(clip["largest_change"] > 2.0 for clip in clips)
    assert cv2.imread(str(out)).std() > 20.0


def test_all_takes_of_a_single_subject_are_shown() -> None:
    rows = gestures.rows_of(DrawnGestures(1, 4))
    assert [(row.subject, row.take) for row in rows] == [("0", take) for take in "0123"]
    assert len(gestures.draw(rows).axes) == 8


def test_the_sheet_shows_the_frames_that_it_names() -> None:
    rows = gestures.rows_of(DrawnGestures(1, 1))
    strip = gestures.draw(rows).axes[0].images[0].get_array()
    clip = rows[0].clips["picture-left"]
    for number, frame in enumerate(gestures.SHOWN_FRAMES):
        left = number * strip.shape[1] // len(gestures.SHOWN_FRAMES)
        np.testing.assert_array_equal(strip[:, left : left + clip.shape[2]], clip[frame])


def test_videos_that_cannot_be_used_give_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "sheet.png")
    assert main(["figure", "gestures", "--gestures", str(tmp_path / "none"), "--out", out]) == 2
    assert "there is no such folder" in capsys.readouterr().err
    assert not Path(out).exists()
