"""What a dashboard shows of a run: what is on the bus, and in its folder if that is here."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Final

from actors.tasks.contract import Task
from proto.body import FOCUS
from proto.bus import Bus, join_hub, open_bus
from proto.config import Config
from proto.errors import UserError
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.membership import METRICS_PERIOD_S
from proto.messages import Command, Control, ControlReply, Pictures
from proto.periodic import every
from proto.permissions import Holder
from proto.plain_text import plain
from services.archive import Archive, RunArchive
from services.board import ActorView, Board, LiveBoard
from services.dashboard.feed import (
    Feed,
    logs_content,
    losses_content,
    processes_content,
    suites_content,
    task_content,
)
from services.dashboard.plane import Plane, PlaneMaker

LOG = logging.getLogger(__name__)

PLANE_PERIOD_S: Final = 5.0
CONTROL_WITHIN_S: Final = 60.0
"""Longest time to wait for replies: the learner writes a checkpoint after its current epoch."""


class Source:
    """What browsers can be told.

    Attributes:
        feed: the topics.
        archive: the recordings.
        task: the task of the run.
    """

    def __init__(self, archive: Archive, task: Task, *, live: bool = False) -> None:
        """Tell of recordings only.

        Args:
            archive: the recordings.
            task: their task.
            live: whether there is more to tell than one recording.
        """
        self.feed = Feed()
        self.feed.put("mode", {"live": live})
        self.archive = archive
        self.task = task
        self.feed.put("task", task_content(task))

    def watch(self, viewer: object, actors: Sequence[str], filmed: Sequence[str]) -> None:
        """Note what a viewer looks at: the actors whose steps and whose pictures it wants."""

    def leave(self, viewer: object) -> None:
        """Note that a viewer has left."""

    def actors(self) -> Mapping[str, ActorView]:
        """What the actors do that somebody looks at."""
        return {}

    def pictures(self, actor: str) -> Pictures | None:  # noqa: ARG002
        """The newest pictures of an actor that somebody looks at; None if there are none."""
        return None

    @property
    def plane(self) -> Plane | None:
        """The plane of the PFC's states; None if there is none."""
        return None

    def control(self, role: Role, command: Command) -> list[str]:
        """Send a command to all processes of a role; the answers in words."""
        return [f"nothing runs here, so there is no {role} for {command}"]


class RunSource(Source):
    """What browsers can be told of a run, live."""

    def __init__(self, config: Config, task: Task) -> None:
        """Know nothing yet; see `following`.

        Args:
            config: configuration of the run.
            task: its task.
        """
        self._files = RunArchive(config.run_folder)
        super().__init__(self._files, task, live=True)
        self._config = config
        self._bus: Bus | None = None
        self._board: Board | None = None
        self._live: LiveBoard | None = None
        self._planes = PlaneMaker(self._files, task.name)
        self._lock = threading.Lock()
        self._viewers: dict[object, tuple[frozenset[str], frozenset[str]]] = {}

    @contextmanager
    def following(self, lifecycle: Lifecycle) -> Iterator[None]:
        """Connect to the run as soon as its hub answers, and follow it until the context ends."""
        connecting = threading.Thread(target=self._connect, args=(lifecycle,), daemon=True)
        connecting.start()
        self._look()
        with ExitStack() as stack:
            stack.enter_context(every(METRICS_PERIOD_S, self._look))
            stack.enter_context(every(PLANE_PERIOD_S, self._look_at_plane))
            yield
        connecting.join()
        if self._bus is not None:
            self._bus.close()

    def watch(self, viewer: object, actors: Sequence[str], filmed: Sequence[str]) -> None:
        """Note what a viewer looks at: the actors whose steps and whose pictures it wants."""
        with self._lock:
            self._viewers[viewer] = (frozenset(actors), frozenset(filmed))
        self._subscribe()

    def leave(self, viewer: object) -> None:
        """Note that a viewer has left."""
        with self._lock:
            self._viewers.pop(viewer, None)
        self._subscribe()

    def actors(self) -> Mapping[str, ActorView]:
        """What the actors do that somebody looks at."""
        return self._live.actors() if self._live is not None else {}

    def pictures(self, actor: str) -> Pictures | None:
        """The newest pictures of an actor that somebody looks at; None if there are none."""
        return self._live.pictures(actor) if self._live is not None else None

    @property
    def plane(self) -> Plane | None:
        """The plane of the PFC's states; None if there is none."""
        return self._planes.plane

    def control(self, role: Role, command: Command) -> list[str]:
        """Send a command to all processes of a role; the answers in words.

        Where the hub asks for certificates, this machine needs that of an operator.
        """
        hub, run, name = self._config.hub, self._config.run.name, f"dashboard-control-{os.getpid()}"
        try:
            with open_bus(hub, run, Role.WATCH, name, holder=Holder.OPERATOR) as bus:
                key = bus.keys.control(role)
                replies = bus.ask(key, Control(command), ControlReply, timeout_s=CONTROL_WITHIN_S)
        except UserError as error:
            return [plain(error, 500)]
        told = sorted(plain(f"{each.role} {each.id}: {each.note}", 300) for each in replies)
        return told or [f"no {role} of run {self._config.run.name} replies"]

    def _connect(self, lifecycle: Lifecycle) -> None:
        name, config = f"dashboard-{os.getpid()}", self._config
        try:
            bus = join_hub(config.hub, config.run.name, Role.WATCH, name, lifecycle)
        except UserError as error:  # such as a certificate that was deleted since the start
            LOG.error("nothing is live: %s", error)
            return
        if bus is None:
            return
        self._bus = bus
        self._live = LiveBoard(bus, float(self.task.start[FOCUS]))
        self._board = Board(bus)
        self._subscribe()

    def _subscribe(self) -> None:
        """Subscribe to what all viewers together look at."""
        with self._lock:
            if self._live is None:
                return
            actors = frozenset().union(*(each for each, _ in self._viewers.values()))
            filmed = frozenset().union(*(each for _, each in self._viewers.values()))
            self._live.watch(actors, filmed)

    @property
    def _watched(self) -> bool:
        with self._lock:
            return bool(self._viewers)

    def _look(self) -> None:
        """Bring the topics up to date, if anybody looks at them."""
        if not self._watched and "run" in self.feed:
            return
        bus, board = self._bus, self._board
        away = bus is None or bus.hub_is_away
        self.feed.put(
            "run",
            {
                "name": self._config.run.name,
                "hub": self._config.hub.endpoint,
                "connected": not away,
                "folder": str(self._files.folder) if self._files.exists else None,
            },
        )
        if board is not None:
            view = board.view()
            self.feed.put("processes", processes_content(view))
            self.feed.put("suites", suites_content(view))
        if self._files.exists:
            self._files.look()
            self.feed.put("logs", logs_content(self._files))
        self.feed.put("losses", losses_content(board, self._files))

    def _look_at_plane(self) -> None:
        if not self._watched:
            return
        self._planes.look()
        if self._planes.plane is not None:
            self.feed.put("plane", self._planes.plane.as_json())
