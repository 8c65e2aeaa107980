"""The recorder: writes every rollout to disk, and keeps the history of the run.

Actors keep a rollout until a recorder has given its receipt. A run may have several recorders, each
with a folder and an id of its own: each records every rollout that is sent while it is there.
The learner keeps the tutored sequences, in the same file format.
"""

from __future__ import annotations

import logging
import time
from functools import cached_property
from pathlib import Path
from typing import Final

from actors.tasks.registry import make_task
from proto.acceptance import misfit
from proto.agreement import OTHER_SETTINGS, digest_of, settings_of
from proto.bus import Bus, Inbox
from proto.config import Config
from proto.disk_waits import when_disk_allows
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.membership import membership
from proto.messages import Receipt, Rollout
from proto.metrics import RecorderMetrics
from proto.plain_text import plain
from proto.recordings.episodes import write_episode
from proto.recordings.schemas import SceneUpdate
from services.monitoring.run_monitor import RunMonitor
from services.recordings import Recordings
from services.robot_meshes import robot_meshes
from services.terminal.run_words import outcome_words

LOG = logging.getLogger(__name__)

WAITING: Final = 64
"""Rollouts that may wait to be written; when more arrive, the oldest are dropped and sent again."""


class Recorder:
    """Writes each rollout once into the run's `rollouts` folder."""

    def __init__(self, config: Config, bus: Bus, lifecycle: Lifecycle) -> None:
        """Find what was recorded before, and start to collect rollouts.

        Raises:
            UserError: the task's options are wrong.
        """
        self._config = config.recorder
        self._task = make_task(config.task)
        self._period_s = config.simulator.control_period_s
        self._digest = digest_of(settings_of(config))
        self._bus = bus
        self._lifecycle = lifecycle
        self._recordings = Recordings(config.run_folder / "rollouts", config.recorder.keep)
        self._inbox: Inbox[Rollout] = bus.inbox(bus.keys.rollout(), Rollout, capacity=WAITING)
        self._monitor = RunMonitor(config, bus)
        self._episodes = 0
        self._bytes = 0

    def run(self) -> None:
        """Record until it should stop, and then what still waits.

        Raises:
            StorageError: it should stop, and a rollout cannot be written to disk.
        """
        with membership(self._bus, self, self._lifecycle), self._monitor.running():
            while not self._lifecycle.stopping or len(self._inbox):
                rollout = self._inbox.take(timeout_s=0.5)
                self._lifecycle.waits_for("" if rollout else self._missing)
                if rollout is not None and self._is_recorded(rollout.episode):
                    self._take(rollout.episode)

    def metrics(self) -> RecorderMetrics:
        """Metrics at this moment."""
        return RecorderMetrics(
            id=self._bus.id,
            time_s=time.time(),
            refused=self._bus.refused,
            episodes=self._episodes,
            bytes=self._bytes,
            dropped=self._inbox.dropped,
            deleted=self._recordings.deleted,
        )

    def checkpoint(self) -> str:
        """Write nothing: a rollout is on disk as soon as it is recorded."""
        return f"{self._episodes} rollouts are in {self._recordings.folder}"

    @property
    def _missing(self) -> str:
        return "the hub" if self._bus.hub_is_away else "a rollout"

    def _is_recorded(self, episode: Episode) -> bool:
        """Whether an episode is a rollout of this run that is to be recorded."""
        if episode.task != self._task.name or episode.config_digest != self._digest:
            self._bus.refuse(f"actor/{episode.actor}", OTHER_SETTINGS)
            return False
        return episode.kind is Kind.TRIAL or (
            self._config.practice and episode.kind is Kind.PRACTICE
        )

    def _take(self, episode: Episode) -> None:
        """Record a rollout if it is one of the task, and answer its actor."""
        refusal = plain(misfit(episode, self._task, self._period_s), 1000 - len("..."))
        if refusal:
            self._bus.refuse(f"actor/{episode.actor}", refusal)
        else:
            self._record(episode)
        receipt = self._bus.keys.receipt(Role.RECORDER, episode.actor)
        self._bus.deliver(receipt, Receipt(episode.id, refusal))

    def _record(self, episode: Episode) -> None:
        """Write a rollout unless it is there already, such as one that was sent again."""
        path = self._recordings.path(episode)
        if not path.exists():
            self._write(path, episode)
            self._episodes += 1
            self._bytes += path.stat().st_size
            self._recordings.add(path, episode.kind)
            self._monitor.note(episode)
            LOG.info(
                "recorded %s of policy %d, seed %d: %s, %s",
                *(episode.kind, episode.policy_version, episode.seed),
                *(plain(outcome_words(episode.outcome.reason)), path.name),
            )

    def _write(self, path: Path, episode: Episode) -> None:
        when_disk_allows(self._lifecycle, lambda: write_episode(path, episode, robot=self._robot))

    @cached_property
    def _robot(self) -> SceneUpdate | None:
        """The robot's meshes; None, with a warning, if this machine cannot build them.

        They are read for the first recording: at the start of a run the actors need the processor.
        """
        try:
            return robot_meshes()
        except UserError as error:
            LOG.warning("viewers will not show the robot in the recordings: %s", error)
            return None
