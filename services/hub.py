"""The hub: the router that all processes connect to, inside a Python process."""

from __future__ import annotations

import logging
import time

from proto.bus import Bus
from proto.config import Config
from proto.lifecycle import Lifecycle
from proto.membership import membership
from proto.metrics import HubMetrics

LOG = logging.getLogger(__name__)


class Hub:
    """Forwards messages between the processes. It stores nothing, so it may restart at any time."""

    def __init__(self, config: Config, bus: Bus, lifecycle: Lifecycle) -> None:
        """Make a hub on a bus that `open_hub` opened: that session is the router."""
        self._endpoint = config.hub.endpoint
        self._bus = bus
        self._lifecycle = lifecycle

    def run(self) -> None:
        """Serve until it should stop."""
        LOG.info("listening at %s", self._endpoint)
        with membership(self._bus, self, self._lifecycle):
            while not self._lifecycle.stopping:
                self._lifecycle.wait(1.0)

    def metrics(self) -> HubMetrics:
        """Metrics at this moment."""
        return HubMetrics(
            id=self._bus.id,
            time_s=time.time(),
            refused=self._bus.refused,
            peers=self._bus.peers,
        )

    def checkpoint(self) -> str:
        """Write nothing: a hub stores nothing."""
        return "a hub stores nothing"
