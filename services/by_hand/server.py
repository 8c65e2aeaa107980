"""The page on which one person tutors one robot."""

from __future__ import annotations

import asyncio
import json
import logging
from pathlib import Path
from typing import Final

from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles

from services.by_hand.requests import request_of
from services.by_hand.robot import Robot
from services.dashboard.access import Access
from services.dashboard.server import NOT_FOR_YOU, TOO_MANY, guarded_app
from services.dashboard.viewer import SEND_WITHIN_S, BadRequestError

LOG = logging.getLogger(__name__)

PAGE: Final = Path(__file__).parent / "page"
PERIOD_S: Final = 0.03


def make_app(robot: Robot, access: Access) -> FastAPI:
    """Make the web application.

    Args:
        robot: the robot.
        access: who may do what.
    """
    app = guarded_app(access)
    app.mount("/by-hand", StaticFiles(directory=PAGE))
    persons: list[WebSocket] = []

    @app.get("/")
    async def page() -> FileResponse:
        return FileResponse(PAGE / "index.html")

    @app.websocket("/robot")
    async def tutor(browser: WebSocket) -> None:
        host, origin = browser.headers.get("host"), browser.headers.get("origin")
        await browser.accept()
        if not access.is_for_us(host) or not access.is_from_us(origin, host):
            await browser.close(NOT_FOR_YOU, "this page is not one of this server")
        elif persons:
            await browser.close(TOO_MANY, "somebody tutors this robot in another window")
        else:
            persons.append(browser)
            try:
                await _serve(browser, robot)
            finally:
                robot.stop()
                persons.remove(browser)

    return app


async def _serve(browser: WebSocket, robot: Robot) -> None:
    """Tell and listen until the browser leaves."""
    telling = asyncio.create_task(_tell(browser, robot))
    try:
        while True:
            text = await browser.receive_text()
            try:
                if not robot.ask(*request_of(text)):
                    raise BadRequestError("the robot is busy: wait, or stop it")
            except BadRequestError as error:
                await browser.send_text(json.dumps({"topic": "refused", "problem": str(error)}))
    except WebSocketDisconnect:
        LOG.info("the browser has left; the robot stands still until it is back")
    finally:
        telling.cancel()


async def _tell(browser: WebSocket, robot: Robot) -> None:
    seen: dict[str, int] = {}
    try:
        while True:
            for text in robot.feed.news(seen):
                await asyncio.wait_for(browser.send_text(text), SEND_WITHIN_S)
            await asyncio.sleep(PERIOD_S)
    except (TimeoutError, WebSocketDisconnect, RuntimeError):
        robot.stop()
        LOG.info("the browser takes nothing more")
