"""The recorder: writes every rollout to disk.

It only listens. The evaluator does not wait for it: a rollout that is published while no recorder
runs is counted but not recorded. The learner keeps the tutored sequences, in the same file format.
"""

from __future__ import annotations

import logging
import time
from typing import Final

from proto.agreement import OTHER_SETTINGS, digest_of, settings_of
from proto.bus import Bus, Inbox
from proto.config import Config
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.lifecycle import Lifecycle
from proto.membership import membership
from proto.messages import Rollout
from proto.metrics import RecorderMetrics
from proto.recordings.episodes import write_episode
from proto.recordings.schemas import SceneUpdate
from services.robot_meshes import robot_meshes

LOG = logging.getLogger(__name__)

WAITING: Final = 64
"""Rollouts that may wait to be written; when more arrive, the oldest are dropped."""


class Recorder:
    """Writes each rollout once, as `<id>.mcap`, into the run's `rollouts` folder."""

    def __init__(self, config: Config, bus: Bus, lifecycle: Lifecycle) -> None:
        """Start to collect rollouts."""
        self._folder = config.run_folder / "rollouts"
        self._practice = config.recorder.practice
        self._task = config.task.name
        self._digest = digest_of(settings_of(config))
        self._bus = bus
        self._lifecycle = lifecycle
        self._inbox: Inbox[Rollout] = bus.inbox(bus.keys.rollout(), Rollout, capacity=WAITING)
        self._robot = _robot()
        self._episodes = 0
        self._bytes = 0
        self._failed = 0

    def run(self) -> None:
        """Record until it should stop, and then what still waits."""
        with membership(self._bus, self, self._lifecycle):
            while not self._lifecycle.stopping or len(self._inbox):
                rollout = self._inbox.take(timeout_s=0.5)
                if rollout is not None and self._is_recorded(rollout.episode):
                    self._record(rollout.episode)

    def metrics(self) -> RecorderMetrics:
        """Metrics at this moment."""
        return RecorderMetrics(
            id=self._bus.id,
            time_s=time.time(),
            refused=self._bus.refused,
            episodes=self._episodes,
            bytes=self._bytes,
            dropped=self._inbox.dropped + self._failed,
        )

    def checkpoint(self) -> str:
        """Write nothing: a rollout is on disk as soon as it is recorded."""
        return f"{self._episodes} rollouts are in {self._folder}"

    def _is_recorded(self, episode: Episode) -> bool:
        """Whether an episode is a rollout of this run that is to be recorded."""
        if episode.task != self._task or episode.config_digest != self._digest:
            self._bus.refuse(f"actor/{episode.actor}", OTHER_SETTINGS)
            return False
        return episode.kind is Kind.TRIAL or (self._practice and episode.kind is Kind.PRACTICE)

    def _record(self, episode: Episode) -> None:
        path = self._folder / f"{episode.id}.mcap"
        if path.exists():  # the actor sent it again because its receipt was late
            return
        try:
            write_episode(path, episode, robot=self._robot)
        except UserError as error:  # such as a full disk, on which space may be freed later
            self._failed += 1
            LOG.warning("rollout %s is not recorded: %s", episode.id, error)
            return
        self._episodes += 1
        self._bytes += path.stat().st_size


def _robot() -> SceneUpdate | None:
    """The robot's meshes; None, with a warning, if this machine cannot build them."""
    try:
        return robot_meshes()
    except UserError as error:
        LOG.warning("viewers will not show the robot in the recordings: %s", error)
        return None
