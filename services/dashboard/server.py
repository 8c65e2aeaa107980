"""The web server of a dashboard: one page, its data over a WebSocket, recordings and videos."""

from __future__ import annotations

import base64
import logging
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response, WebSocket
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles

from actors.attention import crop_of_focus
from actors.simulator import EYE_WIDTH
from actors.tasks.contract import Task
from proto.body import FOCUS
from proto.episode import Episode
from proto.errors import UserError
from proto.plain_text import plain
from proto.recordings.episodes import read_episode
from services.dashboard.access import HEADERS, Access
from services.dashboard.feed import outcome_content, situation_content
from services.dashboard.run_source import Source
from services.dashboard.videos import Videos
from services.dashboard.viewer import REQUEST_LETTERS, Viewer

LOG = logging.getLogger(__name__)

PAGE: Final = Path(__file__).parent / "page"
VIEWERS: Final = 32
"""So many browsers may look at the same time."""
TOO_MANY: Final = 1013
"""Code that closes a connection which may be tried again later."""
NOT_FOR_YOU: Final = 1008
"""Code that closes a connection of a page that is not ours."""
_STOP_WITHIN_S: Final = 10.0


def make_app(source: Source, access: Access, videos: Videos) -> FastAPI:
    """Make the web application.

    Args:
        source: what it tells.
        access: who may do what.
        videos: renders recordings.
    """
    app = guarded_app(access)

    @app.get("/")
    async def page() -> FileResponse:
        return FileResponse(PAGE / "index.html")

    _serve_live(app, source, access)
    _serve_recordings(app, source, videos)
    return app


def guarded_app(access: Access) -> FastAPI:
    """Make a web application that answers only requests for its own address, and serves /page."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @app.middleware("http")
    async def guard(request: Request, answer: Callable[[Request], Awaitable[Response]]) -> Response:
        if access.is_for_us(request.headers.get("host")):
            response = await answer(request)
        else:
            response = Response("this dashboard has another address", status_code=421)
        response.headers.update(HEADERS)
        return response

    app.mount("/page", StaticFiles(directory=PAGE))
    return app


def _serve_live(app: FastAPI, source: Source, access: Access) -> None:
    viewers: set[Viewer] = set()

    @app.websocket("/live")
    async def live(browser: WebSocket) -> None:
        headers = browser.headers
        host, origin = headers.get("host"), headers.get("origin")
        await browser.accept()
        if not access.is_for_us(host) or not access.is_from_us(origin, host):
            await browser.close(NOT_FOR_YOU, "this page is not one of this dashboard")
        elif len(viewers) >= VIEWERS:
            await browser.close(TOO_MANY, f"{VIEWERS} browsers look at this dashboard already")
        else:
            viewer = Viewer(browser, source, control=access.control)
            viewers.add(viewer)
            try:
                await viewer.run()
            finally:
                viewers.discard(viewer)


def _serve_recordings(app: FastAPI, source: Source, videos: Videos) -> None:
    # These functions are not `async`: they read files, and must not hold up what is live.

    @app.get("/episodes/{episode}")
    def recorded(episode: str) -> Mapping[str, Any]:
        return _episode_content(_read(source, episode), source.task)

    @app.get("/episodes/{episode}/video")
    def video_state(episode: str) -> Mapping[str, Any]:
        return videos.ask(episode, _path(source, episode))

    @app.get("/episodes/{episode}/video.mp4")
    def video(episode: str) -> FileResponse:
        path = videos.path(episode)
        if path is None:
            raise HTTPException(404, "there is no such video")
        return FileResponse(path, media_type="video/mp4")


@contextmanager
def serving(app: FastAPI, listening: socket.socket) -> Iterator[None]:
    """Serve an application on a socket, in a thread of its own, until the context ends."""
    config = uvicorn.Config(
        app,
        log_config=None,
        log_level="warning",
        access_log=False,
        server_header=False,
        lifespan="off",
        ws="websockets-sansio",
        ws_max_size=4 * REQUEST_LETTERS,
        ws_per_message_deflate=False,
        limit_concurrency=8 * VIEWERS,
        timeout_keep_alive=30,
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, args=([listening],), daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.should_exit = True
        thread.join(_STOP_WITHIN_S)
        listening.close()


def _path(source: Source, episode: str) -> Path:
    path = source.archive.path(episode)
    if path is None or not path.exists():
        raise HTTPException(
            404, "this recording is gone: of practice only the newest are kept (recorder.keep)"
        )
    return path


def _read(source: Source, episode: str) -> Episode:
    try:
        return read_episode(_path(source, episode), partial=True)
    except UserError as error:
        raise HTTPException(409, plain(error, 500)) from error


def _episode_content(episode: Episode, task: Task) -> Mapping[str, Any]:
    # The picture of a step was taken with the focus that the step before commanded.
    start = float(task.start[FOCUS])
    focus = np.concatenate([[start], episode.actions[:-1, FOCUS]])
    return {
        "id": episode.id,
        "steps": episode.steps,
        "period_s": episode.control_period_s,
        "phase_names": [plain(name, 64) for name in episode.phase_names],
        "phases": episode.phases.tolist(),
        "images": base64.b64encode(episode.images.tobytes()).decode(),
        "crops": [round(crop_of_focus(level).width / EYE_WIDTH, 4) for level in focus],
        "joints": np.round(episode.joints_deg, 1).tolist(),
        "actions": np.round(episode.actions, 2).tolist(),
        "outcome": outcome_content(episode.outcome),
        "situation": situation_content(episode.situation),
    }
