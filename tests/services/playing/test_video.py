"""A replay is a video of the episode with one frame for each step."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from proto.config import Config
from proto.episode import Episode
from proto.recordings.episodes import read_episode, write_episode
from services.cli import main
from services.playing.video import CAPTION_HEIGHT, _progress, write_video

STEPS = (0, 60, 120)
"""Steps of an episode that the tests replay; rendering all would take long."""


@pytest.fixture(scope="module")
def short(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of few steps that lie far apart."""
    episode = read_episode(recordings / "case03_repeat00.mcap")
    path = tmp_path_factory.mktemp("short") / "episode.mcap"
    write_episode(path, steps_of(episode, list(STEPS)))
    return path


def steps_of(episode: Episode, steps: list[int]) -> Episode:
    names = ("images", "actions", "targets", "joints_deg", "phases", "body_poses")
    view = episode.view and replace(episode.view, focal_px=episode.view.focal_px[steps])
    return replace(episode, view=view, **{name: getattr(episode, name)[steps] for name in names})


def read_video(path: Path) -> tuple[list[np.ndarray], float]:
    video = cv2.VideoCapture(str(path))
    assert video.isOpened()
    frames = []
    while (frame := video.read())[0]:
        frames.append(frame[1])
    return frames, video.get(cv2.CAP_PROP_FPS)


def test_the_video_shows_both_views_of_every_step(short: Path, tmp_path: Path) -> None:
    out = tmp_path / "videos" / "episode.mp4"
    assert main(["replay", str(short), "--out", str(out), "--fps", "5"]) == 0
    frames, fps = read_video(out)
    assert len(frames) == len(STEPS) + 5, "the last frame stays for a second"
    assert fps == pytest.approx(5)
    assert {frame.shape for frame in frames} == {(480 + CAPTION_HEIGHT, 1280, 3)}
    for held in frames[len(STEPS) :]:
        assert cv2.absdiff(held, frames[len(STEPS) - 1]).mean() < 1
    frames = frames[: len(STEPS)]
    assert list(out.parent.iterdir()) == [out]
    for frame in frames:
        outside, eye = frame[:480, :640].astype(int), frame[:480, 640:].astype(int)
        for view in (outside, eye):
            assert view.std() > 20, "something is to be seen"
        red = (outside[..., 2] - outside[..., :2].max(axis=2)) > 60
        assert red.any(), "the object, or the robot's cover"
    for before, after in pairwise(frames):
        moved = cv2.absdiff(before, after)[:480]
        assert (moved > 50).any(axis=2)[:, :640].sum() > 500
        assert (moved > 50).any(axis=2)[:, 640:].sum() > 500


def test_the_outcome_is_told_in_the_last_step_only(recordings: Path) -> None:
    episode = read_episode(recordings / "case03_repeat00.mcap")
    texts = [_progress(episode, step) for step in range(episode.steps)]
    assert [n for n, text in enumerate(texts) if "utcome" in text] == [episode.steps - 1]
    assert "Outcome: precise" in texts[-1]
    assert texts[0] == f"step 1 of {episode.steps}: {episode.phase_names[0]}"


def test_several_episodes_follow_each_other(recordings: Path, tmp_path: Path) -> None:
    both = [
        steps_of(read_episode(recordings / f"case{case}_repeat00.mcap"), [0])
        for case in ("03", "41")
    ]
    write_video(both, tmp_path / "both.gif", Config(), fps=2)
    frames, _ = read_video(tmp_path / "both.gif")
    assert len(frames) == 2 * (1 + 2)
    assert cv2.absdiff(frames[0], frames[-1]).mean() > 1


def test_recordings_are_exported_as_videos(short: Path, tmp_path: Path) -> None:
    assert main(["export", str(short.parent), "--format", "video", "--out", str(tmp_path)]) == 0
    assert len(read_video(tmp_path / f"{read_episode(short).id}.mp4")[0]) == len(STEPS) + 10


def test_the_recorded_picture_agrees_with_the_rendered_view(short: Path, tmp_path: Path) -> None:
    """The inset is what the network was given; the frame says where it lies in the eye's view."""
    out = tmp_path / "episode.mp4"
    assert main(["replay", str(short), "--out", str(out)]) == 0
    frames, fps = read_video(out)
    episode = read_episode(short)
    assert fps == pytest.approx(1 / episode.control_period_s)
    inset = cv2.cvtColor(frames[0], cv2.COLOR_BGR2GRAY)[:480][-145:-1, -193:-1]
    shown = cv2.resize(inset, (64, 48), interpolation=cv2.INTER_AREA)
    assert np.abs(shown.astype(int) - episode.images[0]).mean() < 6
    # at step 0 the focus is wide: the crop is the whole view
    view = cv2.cvtColor(frames[0], cv2.COLOR_BGR2GRAY)[:480, 640:]
    small = cv2.resize(view, (64, 48), interpolation=cv2.INTER_AREA)[5:30, :40]
    assert np.abs(small.astype(int) - episode.images[0][5:30, :40]).mean() < 12


def test_a_recovered_episode_can_be_replayed(recordings: Path, tmp_path: Path) -> None:
    path, out = tmp_path / "cut.mcap", tmp_path / "cut.mp4"
    whole = (recordings / "case03_repeat00.mcap").read_bytes()
    path.write_bytes(whole[: len(whole) // 4])
    assert main(["replay", str(path), "--out", str(out)]) == 2
    assert main(["recover", str(path)]) == 0
    recovered = read_episode(path, partial=True)
    write_episode(path, steps_of(recovered, [recovered.steps - 1]))
    assert main(["replay", str(path), "--out", str(out)]) == 0
    assert len(read_video(out)[0]) == 1 + 10


OWN_BACKEND = """
import numpy as np

from actors.backends.sapien.simulator import SapienSimulator


class Blue(SapienSimulator):
    def outside_picture(self, width, height):
        return np.full((height, width, 3), (0, 0, 255), dtype=np.uint8)
"""


def test_an_episode_of_a_users_backend_is_replayed_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    (tmp_path / "own_backend.py").write_text(OWN_BACKEND)
    tutor = "tutor --cases 3 --repeats 1 --workers 1 --out . --backend own_backend:Blue"
    assert main(tutor.split()) == 0
    episode = read_episode(Path("case03_repeat00.mcap"))
    assert episode.backend == "own_backend:Blue"
    write_episode(Path("short.mcap"), steps_of(episode, [60]))
    assert main(["replay", "short.mcap", "--out", "own.mp4"]) == 0
    frame = read_video(Path("own.mp4"))[0][0]
    outside, eye = frame[:480, :640], frame[:480, 640:]
    assert outside.mean(axis=(0, 1)) == pytest.approx((255, 0, 0), abs=10), "blue green red"
    assert eye.std() > 20, "something is to be seen"


def write_gestures(folder: Path) -> None:
    """Two gesture videos of an even grey."""
    for side, grey in (("picture-left", 60), ("picture-right", 200)):
        (folder / side).mkdir(parents=True)
        name = str(folder / side / "take.avi")
        writer = cv2.VideoWriter(name, cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 64))
        for _ in range(10):
            writer.write(np.full((64, 64, 3), grey, dtype=np.uint8))
        writer.release()


def test_gestures_of_ones_own_are_replayed_on_the_screen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_gestures(tmp_path / "gestures")
    options = ["--set", "task.name=experiment2", "--set", "task.gestures=gestures"]
    blind = ["--set", "simulator.render=false", "--workers", "1"]
    assert main(["tutor", "--cases", "0", "--repeats", "1", "--out", ".", *options, *blind]) == 0
    episode = read_episode(Path("case00_repeat00.mcap"))
    assert episode.situation["indicated_x_m"] == "-0.15"
    write_episode(Path("short.mcap"), steps_of(episode, [0]))
    assert main(["replay", "short.mcap", "--out", "video.mp4"]) == 2
    assert "--set task.gestures=FOLDER" in capsys.readouterr().err
    assert main(["replay", "short.mcap", "--out", "video.mp4", *options]) == 0
    eye = read_video(Path("video.mp4"))[0][0][:, 640:]
    assert eye[240, 320] == pytest.approx((200, 200, 200), abs=8), "the screen"


def test_an_unknown_backend_is_named(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "video.mp4"
    assert main(["replay", str(short), "--out", str(out), "--backend", "nothing"]) == 2
    assert "there is no 'nothing'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "command",
    [
        ["replay", "missing.mcap", "--out", "video.avi"],
        ["evaluate", "--policy", "missing", "--video", "video.avi"],
    ],
)
def test_a_video_of_another_format_is_refused_before_anything_starts(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert ended.value.code == 2
    assert "video.avi: the name of a video must end in .mp4 or .gif" in capsys.readouterr().err
