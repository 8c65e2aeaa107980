"""Keeps the history of a run, and what TensorBoard shows of it, beside other work."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from learner.checkpoint import NETWORK_PREFIX
from learner.policy_message import policy_of
from proto.bus import Bus
from proto.config import Config
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.messages import PolicyVersion
from proto.periodic import every
from proto.plain_text import plain
from services.board import Board
from services.monitoring.history_files import HistoryFiles
from services.monitoring.sample import Sampler

LOG = logging.getLogger(__name__)

PERIOD_S: Final = 1.0
"""Time between two samples at first."""
VIDEOS: Final = 200
"""An event file holds videos of the failures of so many policy versions."""
_POLICIES_WAITING: Final = 4


class RunMonitor:
    """Watches a run and writes into its folder: `metrics.jsonl` and an event file.

    All work is done in a thread of its own. Whatever goes wrong there is logged and ends nothing.
    """

    def __init__(self, config: Config, bus: Bus) -> None:
        """Start to listen.

        Args:
            config: the configuration of the run.
            bus: connection to the other processes.

        Raises:
            StorageError: the history cannot be repaired after a power failure.
        """
        self._config = config
        self._board = Board(bus)
        self._sampler = Sampler()
        self._files = HistoryFiles(config.run_folder, bus.id, period_s=PERIOD_S)
        self._wanted = {suite.name: len(suite.test_seeds) for suite in config.suites}
        self._policies: deque[PolicyVersion] = deque(maxlen=_POLICIES_WAITING)
        self._failures: deque[Episode] = deque(maxlen=_POLICIES_WAITING)
        self._filmed: set[tuple[str, int]] = set()
        bus.subscribe_newest(bus.keys.policy, self._policies.append, PolicyVersion)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Work until the context ends, then write what is left."""
        with every(PERIOD_S, self._work):
            yield
        try:
            self._work()
            self._files.flush()
        except Exception:
            LOG.exception("the end of the history could not be written")

    def note(self, episode: Episode) -> None:
        """Note a recorded episode: the first trial of a policy version that failed is shown."""
        version = (episode.training, episode.policy_version)
        if episode.kind is not Kind.TRIAL or episode.outcome.strict or version in self._filmed:
            return
        if len(self._filmed) < VIDEOS:
            self._filmed.add(version)
            self._failures.append(episode)

    def _work(self) -> None:
        now_s = time.time()
        if self._files.history.is_due(now_s):
            view, epochs = self._board.view(), self._board.take_epochs()
            sample = self._sampler.sample(view, now_s, epochs)
            if sample.says_something:
                self._files.history.add(sample)
                self._files.curves.add(sample, self._wanted)
        while self._policies:
            self._add_weights(self._policies.popleft(), now_s)
        while self._failures:
            self._add_video(self._failures.popleft(), now_s)
        self._files.flush_if_due()

    def _add_weights(self, policy: PolicyVersion, now_s: float) -> None:
        try:
            weights = policy_of(policy, self._config).part(NETWORK_PREFIX)
        except UserError as error:
            LOG.warning("policy %d is not shown: %s", policy.version, plain(error))
            return
        self._files.curves.add_weights(weights, version=policy.version, time_s=now_s)

    def _add_video(self, episode: Episode, now_s: float) -> None:
        self._files.events.video(
            f"failure/{episode.suite}",
            episode.images,
            fps=1.0 / episode.control_period_s,
            step=episode.policy_version,
            time_s=now_s,
        )
