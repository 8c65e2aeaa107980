"""Renders a recorded episode as a video: an outside view of the scene beside the eye image."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from textwrap import wrap
from typing import Final

import cv2
import numpy as np

from actors.attention import crop_of_focus
from actors.disturbances.staging import stage
from actors.simulator import EYE_HEIGHT, EYE_WIDTH, Crop, Pose, Simulator, make_simulator
from actors.tasks.contract import Task
from actors.tasks.registry import make_task
from proto.body import FOCUS
from proto.config import Config
from proto.disturbances import DISTURBANCES
from proto.episode import NO_FAILURE, Episode, Outcome
from proto.errors import UserError
from proto.variables import situation_text
from services.playing.video_file import Picture, check_video_name, video_file

PANEL_WIDTH: Final = 640
PANEL_HEIGHT: Final = 480
HOLD_S: Final = 1.0
"""The last picture of an episode, with the outcome, stays for this time."""
_LINE: Final = 24
_LINE_LETTERS: Final = 150
"""So many letters of the caption fit beside each other."""
_MARGIN: Final = 12
CAPTION_HEIGHT: Final = 4 * _LINE + _MARGIN
"""Height of the caption below the pictures: four lines."""
_WHITE: Final = (255, 255, 255)
_BAND: Final = 40


def write_video(
    episodes: Sequence[Episode],
    out: Path,
    config: Config,
    *,
    fps: float | None = None,
    on_frame: Callable[[], None] = lambda: None,
) -> None:
    """Render every step of recorded episodes into a video, one episode after the other.

    Nothing is simulated: the simulator shows the recorded joints and bodies of each step.

    Args:
        episodes: the recorded episodes, at least one; all of the same task and simulator.
        out: the file to write, .mp4 (H.264) or .gif; it appears under its name only when it is
            complete.
        config: the simulator that renders, and options of the task.
        fps: frames per second, one frame for each control step; None for real time. The last frame
            of each episode stays for HOLD_S.
        on_frame: called after each frame.

    Raises:
        UserError: the name of the file has another ending, the simulator cannot render, the scene
            needs an option of the task, or the file cannot be written.
    """
    check_video_name(out)
    for episode in episodes:
        if not episode.situation:
            raise UserError(
                f"the situation of {episode.id} is not known, so there is no scene to show"
            )
    rate = fps or 1.0 / episodes[0].control_period_s
    task = make_task(config.task_called(episodes[0].task))
    with (
        closing(make_simulator(config.simulator.model_copy(update={"render": True}))) as simulator,
        video_file(out, rate) as write,
    ):
        for number, episode in enumerate(episodes, 1):
            title = f"{number} of {len(episodes)}: " if len(episodes) > 1 else ""
            for frame in frames(episode, simulator, task, title):
                write(frame)
                on_frame()
            for _ in range(round(HOLD_S * rate)):
                write(frame)


def frames(
    episode: Episode, simulator: Simulator, task: Task, title: str = ""
) -> Iterator[Picture]:
    """Yield one picture (588, 1280, 3) uint8, RGB, for each step of an episode of a task.

    Args:
        episode: the episode.
        simulator: renders it.
        task: its task.
        title: text at the beginning of the caption.
    """
    staging = stage(task, episode.situation, episode.conditions, episode.seed)
    simulator.reset(staging.scene)
    for step in range(episode.steps):
        poses = _poses(episode, step)
        joints_deg = episode.joints_deg[step].astype(np.float64)
        simulator.show(joints_deg, poses, step)
        outside = simulator.outside_picture(PANEL_WIDTH, PANEL_HEIGHT)
        focus = _focus_before(episode, step, float(task.start[FOCUS]))
        eye = simulator.eye_picture(Crop(), PANEL_WIDTH, PANEL_HEIGHT).copy()
        _draw_crop(eye, focus)
        _insert_recorded_image(eye, episode.images[step])
        caption = _caption_picture(episode, step, focus, title)
        yield np.vstack([np.hstack([outside, eye]), caption])


def _poses(episode: Episode, step: int) -> Mapping[str, Pose]:
    poses = {}
    rows = episode.body_poses[step].tolist()
    for name, (x, y, z, *quaternion) in zip(episode.body_names, rows, strict=True):
        w, i, j, k = quaternion
        poses[name] = Pose((x, y, z), (w, i, j, k))
    return poses


def _draw_crop(eye: Picture, focus: float) -> None:
    """Draw a white frame around the crop of the focus level."""
    crop = crop_of_focus(focus)
    across, down = crop.width / EYE_WIDTH / 2, crop.height / EYE_HEIGHT / 2
    corner = (round(PANEL_WIDTH * (0.5 - across)), round(PANEL_HEIGHT * (0.5 - down)))
    opposite = (round(PANEL_WIDTH * (0.5 + across)) - 1, round(PANEL_HEIGHT * (0.5 + down)) - 1)
    cv2.rectangle(eye, corner, opposite, _WHITE, 1)


def _insert_recorded_image(eye: Picture, image: Picture) -> None:
    """Insert the recorded image, which the policy saw, into the lower right corner."""
    enlarged = cv2.resize(image, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST)
    framed = cv2.copyMakeBorder(enlarged, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=_WHITE)
    eye[-framed.shape[0] :, -framed.shape[1] :] = framed[..., None]


def _focus_before(episode: Episode, step: int, start: float) -> float:
    """Return the focus level at which images[step] was taken: that of the action before."""
    return start if step == 0 else float(episode.actions[step - 1, FOCUS])


def _caption_picture(episode: Episode, step: int, focus: float, title: str) -> Picture:
    """The caption in white on a dark band (CAPTION_HEIGHT, 1280, 3)."""
    picture = np.full((CAPTION_HEIGHT, 2 * PANEL_WIDTH, 3), _BAND, dtype=np.uint8)
    what, progress = _played(episode, title), _progress(episode, step)
    situation = wrap(situation_text(episode.situation), _LINE_LETTERS, max_lines=2)
    _write_lines(picture, [what, progress, *situation])
    _write_lines(picture[:, PANEL_WIDTH:], [_eye_words(focus), "small picture: what it gets"])
    return picture


def _played(episode: Episode, title: str) -> str:
    """Such as `1 of 3: experiment1 in sapien, trial by network version 4`."""
    policy = episode.policy
    if episode.policy_version:
        policy += f" version {episode.policy_version}"
    return (
        f"{title}{episode.task} in {episode.backend},"
        f" {episode.kind} by {policy}{_disturbance(episode)}"
    )


def _progress(episode: Episode, step: int) -> str:
    """Step and phase, and in the last step the outcome, which is known only then."""
    phase = episode.phase_names[episode.phases[step]]
    words = f"step {step + 1} of {episode.steps}: {phase}"
    if step == episode.steps - 1:
        words += f". Outcome: {_in_words(episode.outcome)}"
    return words


def _eye_words(focus: float) -> str:
    return f"left eye; white frame: what the network sees, focus level {focus:.0f}"


def _disturbance(episode: Episode) -> str:
    """Such as `, pushed 20 mm`; empty without a disturbance."""
    conditions = episode.conditions
    if conditions is None or not conditions.disturbance:
        return ""
    unit = DISTURBANCES[conditions.disturbance].unit
    return f", {conditions.disturbance} {conditions.strength:.3g} {unit}"


def _in_words(outcome: Outcome) -> str:
    reached = [name for name in ("lenient", "strict", "precise") if getattr(outcome, name)]
    words = reached[-1] if reached else "failed"
    if outcome.reason != NO_FAILURE:
        words += f" ({outcome.reason.replace('_', ' ')})"
    return words


def _write_lines(picture: Picture, lines: Sequence[str]) -> None:
    for number, line in enumerate(lines, 1):
        place = (_MARGIN, number * _LINE)
        cv2.putText(picture, line, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _WHITE, 1, cv2.LINE_AA)
