"""The recorder: keeps every rollout on disk.

It only listens. What the evaluator counts does not wait for it, so a rollout that is published
while no recorder runs is counted but not kept. Tutored sequences are kept by the learner, in the
same format.
"""

from __future__ import annotations

import logging
import time
from typing import Final

from proto.bus import Inbox, open_bus
from proto.config import Config
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.keys import Role
from proto.membership import Lifecycle, membership
from proto.messages import Rollout
from proto.metrics import RecorderMetrics
from proto.recordings.episodes import write_episode

LOG = logging.getLogger(__name__)

WAITING: Final = 64
"""Rollouts that may wait to be written; of more, the oldest are dropped."""


class Recorder:
    """Writes each rollout once, as `<id>.mcap`, into the run's `rollouts` folder."""

    def __init__(self, config: Config, process: str) -> None:
        """Connect and start listening.

        Raises:
            UserError: no hub answers.
        """
        self._folder = config.run_folder / "rollouts"
        self._practice = config.recorder.practice
        self._bus = open_bus(config.hub, config.run.name, Role.RECORDER, process)
        self._inbox: Inbox[Rollout] = self._bus.inbox(
            self._bus.keys.rollout(), Rollout, capacity=WAITING
        )
        self._episodes = 0
        self._bytes = 0
        self._failed = 0

    def run(self, lifecycle: Lifecycle) -> None:
        """Record until it should stop, and then what still waits."""
        with self._bus, membership(self._bus, self, lifecycle):
            while not lifecycle.stopping or len(self._inbox):
                rollout = self._inbox.take(timeout_s=0.5)
                if rollout is not None and (self._practice or rollout.episode.kind is Kind.TRIAL):
                    self._record(rollout.episode)

    def metrics(self) -> RecorderMetrics:
        """What it tells about itself."""
        return RecorderMetrics(
            id=self._bus.id,
            time_s=time.time(),
            refused=self._bus.refused,
            episodes=self._episodes,
            bytes=self._bytes,
            dropped=self._inbox.dropped + self._failed,
        )

    def checkpoint(self) -> str:
        """Every rollout is on disk as soon as it is written."""
        return f"{self._episodes} rollouts are in {self._folder}"

    def _record(self, episode: Episode) -> None:
        path = self._folder / f"{episode.id}.mcap"
        if path.exists():  # sent again because its receipt was late
            return
        try:
            write_episode(path, episode)
        except UserError as error:  # a full disk must not end it
            self._failed += 1
            LOG.warning("rollout dropped: %s", error)
            return
        self._episodes += 1
        self._bytes += path.stat().st_size
