"""One browser that looks at a dashboard: what it is told, and what it asks for.

A viewer is told what is newest when it has taken what it was told before. So a slow one is told
less, and holds up nobody.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Sequence
from typing import Any, Final

from fastapi import WebSocket, WebSocketDisconnect

from proto.keys import Role
from proto.messages import Command
from proto.plain_text import plain
from proto.senders import is_id
from services.dashboard.feed import EPISODES_AT_ONCE, actor_content, episodes_text, pictures_text
from services.dashboard.run_source import Source

LOG = logging.getLogger(__name__)

PERIOD_S: Final = 0.1
"""Least time between two pictures of an actor."""
SEND_WITHIN_S: Final = 30.0
"""A browser that takes nothing for this time is given up."""
ACTORS_WATCHED: Final = 12
"""A viewer may watch so many actors at a time."""
REQUEST_LETTERS: Final = 4096


class BadRequestError(Exception):
    """A browser asked for something that cannot be."""


class Viewer:
    """The connection to one browser."""

    def __init__(self, socket: WebSocket, source: Source, *, control: bool) -> None:
        """Look at nothing yet.

        Args:
            socket: the connection, which has been accepted.
            source: what can be told.
            control: whether it may control the run.
        """
        self._socket = socket
        self._source = source
        self._control = control
        self._sending = asyncio.Lock()
        self._seen: dict[str, int] = {}
        self._episodes = 0
        self._paths: dict[str, tuple[int, int]] = {}
        self._filmed: tuple[str, ...] = ()
        self._shown_pictures: dict[str, int] = {}
        self._commands: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Tell and listen until the browser leaves."""
        self._source.watch(self, (), ())
        telling = asyncio.create_task(self._tell())
        try:
            await self._listen()
        except WebSocketDisconnect:
            pass
        finally:
            telling.cancel()
            for command in self._commands:
                command.cancel()
            self._source.leave(self)

    async def _tell(self) -> None:
        try:
            await self._send(json.dumps({"topic": "viewer", "control": self._control}))
            while True:
                for text in self._source.feed.news(self._seen):
                    await self._send(text)
                await self._tell_episodes()
                await self._tell_actors()
                await self._tell_pictures()
                await asyncio.sleep(PERIOD_S)
        except (TimeoutError, WebSocketDisconnect, RuntimeError):
            await self._close()
        except Exception:
            LOG.exception("a browser cannot be told any more")
            await self._close()

    async def _tell_episodes(self) -> None:
        found = self._source.archive.since(self._episodes)
        for first in range(0, len(found), EPISODES_AT_ONCE):
            told = found[first : first + EPISODES_AT_ONCE]
            await self._send(episodes_text(told))
            self._episodes = told[-1].number

    async def _tell_actors(self) -> None:
        news: dict[str, Any] = {}
        for name, view in self._source.actors().items():
            now, known = (view.episode, view.live.step), self._paths.get(name, (0, -1))
            if now != known:
                news[name] = actor_content(view, self._source.plane, known)
                self._paths[name] = now
        if news:
            await self._send(json.dumps({"topic": "actors", "actors": news}, allow_nan=False))

    async def _tell_pictures(self) -> None:
        for name in self._filmed:
            pictures = self._source.pictures(name)
            if pictures is not None and self._shown_pictures.get(name) != id(pictures):
                self._shown_pictures[name] = id(pictures)
                await self._send(await asyncio.to_thread(pictures_text, pictures))

    async def _listen(self) -> None:
        while True:
            text = await self._socket.receive_text()
            try:
                self._obey(text)
            except BadRequestError as error:
                await self._send(json.dumps({"topic": "told", "problem": str(error)}))

    def _obey(self, text: str) -> None:
        """Do what a browser asks for.

        Raises:
            BadRequestError: it cannot be done.
        """
        asked = parsed(text)
        match asked:
            case {"watch": list(actors), "film": list(filmed)}:
                self._filmed = _ids(filmed)
                self._source.watch(self, _ids(actors), self._filmed)
            case {"command": str(command), "role": str(role)}:
                if not self._control:
                    raise BadRequestError(
                        "this dashboard only shows the run: start it with --allow-control to "
                        "control the run too"
                    )
                if role not in list(Role) or command not in list(Command):
                    raise BadRequestError(f"there is no {plain(command, 64)} of {plain(role, 64)}")
                doing = asyncio.create_task(self._do(Role(role), Command(command)))
                self._commands.add(doing)
                doing.add_done_callback(self._commands.discard)
            case _:
                raise BadRequestError("that is not a request")

    async def _do(self, role: Role, command: Command) -> None:
        LOG.info("a viewer asks every %s to %s", role, command)
        replies = await asyncio.to_thread(self._source.control, role, command)
        await self._send(json.dumps({"topic": "told", "replies": replies}))

    async def _send(self, text: str) -> None:
        """Send a text.

        Raises:
            TimeoutError: the browser takes nothing.
        """
        async with self._sending:
            await asyncio.wait_for(self._socket.send_text(text), SEND_WITHIN_S)

    async def _close(self) -> None:
        try:
            await asyncio.wait_for(self._socket.close(), 1.0)
        except (TimeoutError, RuntimeError, WebSocketDisconnect):
            LOG.info("a browser has left")


def parsed(text: str) -> Any:
    """Return what a browser sent as JSON.

    Raises:
        BadRequestError: it is too long, or no JSON.
    """
    if len(text) > REQUEST_LETTERS:
        raise BadRequestError("that request is too long")
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        raise BadRequestError("that is not JSON") from None


def _ids(names: Sequence[Any]) -> tuple[str, ...]:
    """Ids of actors, at most so many as a viewer may watch."""
    found = [name for name in names if isinstance(name, str) and is_id(name)]
    return tuple(dict.fromkeys(found))[:ACTORS_WATCHED]
