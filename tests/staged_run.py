"""A run whose processes are sessions of a test, and a dashboard that shows it."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from run_metrics import ACTOR, EVALUATOR, LEARNER

from actors.tasks.registry import make_task
from proto.bus import Bus, open_bus
from proto.config import Config
from proto.episode import Episode
from proto.lifecycle import Lifecycle
from proto.messages import EYE_SIZE, OUTSIDE_SIZE, Command, Control, ControlReply, Live, Pictures
from proto.metrics import Metrics
from proto.recordings.episodes import write_episode
from services.dashboard.access import Access
from services.dashboard.ports import address_of, listening_socket
from services.dashboard.run_source import RunSource
from services.dashboard.server import make_app, serving
from services.dashboard.videos import Videos


class StagedRun:
    """A run whose processes are sessions of this test: real messages over a real hub.

    Attributes:
        config: the configuration of the run.
        commands: what the learner was told.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.commands: list[Command] = []
        self._buses: dict[str, Bus] = {}

    def join(self, metrics: Metrics) -> Bus:
        """Join as a process."""
        bus = open_bus(self.config.hub, self.config.run.name, metrics.role, metrics.id)
        bus.answer(bus.keys.control(metrics.role), Control, self._on_control(metrics))
        bus.announce()
        self._buses[metrics.id] = bus
        return bus

    def tell(self, metrics: Metrics) -> None:
        """Publish metrics of a process that has joined."""
        bus = self._buses[metrics.id]
        bus.publish(bus.keys.metrics(metrics.role, metrics.id), metrics)

    def leave(self, name: str) -> None:
        """End the session of a process."""
        self._buses.pop(name).close()

    def watched(self, name: str) -> bool:
        """Whether anybody looks at an actor."""
        bus = self._buses[name]
        return bus.watched(bus.keys.live(name))

    def act(self, episode: Episode, step: int) -> None:
        """Publish a step of an episode as the actor `a-1`, and what the scene looks like."""
        bus = self._buses[ACTOR.id]
        live = Live(
            actor=bus.id,
            kind=episode.kind,
            policy=episode.policy,
            policy_version=episode.policy_version,
            step=step,
            phase=episode.phase_names[episode.phases[step]],
            image=episode.images[step],
            joints_deg=episode.joints_deg[step],
            action=episode.actions[step],
            body_poses=episode.body_poses[step],
            focal_px=np.array([50.0, 60.0], np.float32),
        )
        bus.publish(bus.keys.live(bus.id), live)
        if bus.watched(bus.keys.pictures(bus.id)):
            outside, eye = np.full(OUTSIDE_SIZE, 90, np.uint8), np.full(EYE_SIZE, 60, np.uint8)
            bus.publish(bus.keys.pictures(bus.id), Pictures(bus.id, step, outside, eye))

    def close(self) -> None:
        """End all sessions."""
        for bus in self._buses.values():
            bus.close()

    def _on_control(self, metrics: Metrics) -> Callable[[Control], ControlReply]:
        def answer(control: Control) -> ControlReply:
            self.commands.append(control.command)
            return ControlReply(metrics.role, metrics.id, "done")

        return answer


def record(folder: Path, episode: Episode) -> None:
    """Write a recording as the processes of a run do."""
    write_episode(folder / f"{episode.id}.mcap", episode)


@contextmanager
def dashboard(
    config: Config, *, control: bool = False, port: int = 0, sends_at_most: int | None = None
) -> Iterator[str]:
    """Serve a run in this process; gives the address of the page.

    Args:
        config: configuration of the run.
        control: let the page control the run.
        port: port of the page; 0 for any free one.
        sends_at_most: bytes on their way to a browser; None for the usual.
    """
    lifecycle = Lifecycle()
    source = RunSource(config, make_task(config.task))
    listening = listening_socket("127.0.0.1", port)
    if sends_at_most is not None:  # its connections inherit this
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, sends_at_most)
    access = Access("127.0.0.1", control)
    with (
        Videos(config) as videos,
        serving(make_app(source, access, videos), listening),
        source.following(lifecycle),
    ):
        try:
            yield address_of(listening)
        finally:
            lifecycle.stop()


class Told:
    """Publishes metrics and steps of a staged run; the numbers rise."""

    def __init__(self, run: StagedRun, episode: Episode) -> None:
        self._run = run
        self._episode = episode
        self._count = 0

    def once(self) -> None:
        """Publish metrics and a step."""
        self._count += 1
        learner = replace(LEARNER, epoch=LEARNER.epoch + self._count, loss=0.5 / self._count)
        self._run.tell(learner)
        self._run.tell(EVALUATOR)
        self._run.tell(replace(ACTOR, episodes=self._count))
        self._run.act(self._episode, self._count % self._episode.steps)
