"""Videos of recordings, rendered one after another in a process of low priority."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, Final, Self

from proto.config import Config
from proto.errors import UserError
from proto.plain_text import plain
from services.playing.parent import end_with_parent

LOG = logging.getLogger(__name__)

WAITING: Final = 8
"""So many videos may wait to be rendered."""
KEPT: Final = 40
"""So many videos are kept; the oldest are deleted."""


@dataclass
class _Video:
    path: Path
    rendering: Future[None]


class Videos:
    """Videos of recordings, made on request and kept until this ends."""

    def __init__(self, config: Config) -> None:
        """Render nothing yet; the process starts with the first video.

        Args:
            config: options of the task.
        """
        self._config = config
        self._folder = tempfile.TemporaryDirectory(prefix="vmdnn-videos-")
        self._lock = threading.Lock()
        self._begun = 0
        self._videos: OrderedDict[str, _Video] = OrderedDict()
        self._context = multiprocessing.get_context("spawn")
        self._frames: Synchronized[int] = self._context.Value("i", 0)
        self._ended = self._context.Event()
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop rendering and delete all videos."""
        self._ended.set()  # the video that is rendered now ends with its next frame
        with self._lock:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(wait=True, cancel_futures=True)
        self._folder.cleanup()

    def ask(self, episode: str, recording: Path) -> Mapping[str, Any]:
        """Say how far the video of an episode is; begin to render it if nobody has asked before.

        Args:
            episode: id of the episode.
            recording: its file.

        Returns:
            `state`: `ready`, `rendering`, `waiting` or `failed`; and how many `frames` there are,
            how many videos are `before` it, or what is the `problem`.
        """
        with self._lock:
            video = self._videos.get(episode)
            if video is None:
                waiting = sum(not each.rendering.done() for each in self._videos.values())
                if waiting >= WAITING:
                    problem = f"{waiting} other videos are being rendered; try again later"
                    return {"state": "failed", "problem": problem}
                video = self._begin(episode, recording)
            return self._state_of(video, episode)

    def path(self, episode: str) -> Path | None:
        """The file of a video that is ready; None if there is none."""
        with self._lock:
            video = self._videos.get(episode)
            return video.path if video is not None and _is_ready(video) else None

    def _begin(self, episode: str, recording: Path) -> _Video:
        self._begun += 1
        out = Path(self._folder.name) / f"{self._begun}.mp4"
        if self._pool is None:
            self._pool = ProcessPoolExecutor(
                1, self._context, _begin_worker, (self._frames, self._ended)
            )
        rendering = self._pool.submit(_render, recording, out, self._config)
        self._videos[episode] = _Video(out, rendering)
        # In a thread of its own, because the pool may hold its lock when it calls back.
        rest = threading.Thread(target=self._rest, daemon=True)
        rendering.add_done_callback(lambda _: rest.start())
        for name in [name for name, each in self._videos.items() if each.rendering.done()]:
            if len(self._videos) <= KEPT:
                break
            self._videos.pop(name).path.unlink(missing_ok=True)
        return self._videos[episode]

    def _rest(self) -> None:
        """End the process if nothing is left to render: a simulator takes much memory."""
        with self._lock:
            if self._pool is not None and all(e.rendering.done() for e in self._videos.values()):
                self._pool.shutdown(wait=False)
                self._pool = None

    def _state_of(self, video: _Video, episode: str) -> Mapping[str, Any]:
        if _is_ready(video):
            return {"state": "ready"}
        if video.rendering.done():
            self._videos.pop(episode)  # who asks again, tries again
            if video.rendering.cancelled():
                return {"state": "failed", "problem": "the dashboard is being stopped"}
            return {"state": "failed", "problem": self._problem(video.rendering.exception())}
        before = 0
        for name, each in self._videos.items():
            if name == episode:
                break
            before += not each.rendering.done()
        if before:
            return {"state": "waiting", "before": before}
        return {"state": "rendering", "frames": self._frames.value}

    def _problem(self, error: BaseException | None) -> str:
        if isinstance(error, UserError):
            return plain(error, 500)
        LOG.error("a video could not be rendered: %r", error)
        return "the video could not be rendered; the log of the dashboard says why"


def _is_ready(video: _Video) -> bool:
    done = video.rendering
    return done.done() and not done.cancelled() and done.exception() is None


_frames: Synchronized[int]
_ended: Event


def _begin_worker(frames: Synchronized[int], ended: Event) -> None:
    global _frames, _ended
    _frames, _ended = frames, ended
    os.nice(10)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches it too; the dashboard ends it
    threading.Thread(target=end_with_parent, daemon=True).start()


class _EndedError(Exception):
    """The dashboard ends."""


def _render(recording: Path, out: Path, config: Config) -> None:
    # The process that serves the page needs no simulator.
    from proto.recordings.episodes import read_episode  # noqa: PLC0415
    from services.playing.video import write_video  # noqa: PLC0415

    episode = read_episode(recording, partial=True)
    simulator = config.simulator.model_copy(update={"backend": episode.backend})
    _frames.value = 0

    def on_frame() -> None:
        _frames.value += 1
        if _ended.is_set():
            raise _EndedError

    write_video(
        [episode], out, config.model_copy(update={"simulator": simulator}), on_frame=on_frame
    )
