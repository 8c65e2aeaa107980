"""The hub: the router that all processes connect to, inside a Python process."""

from __future__ import annotations

import logging
import time

from proto.bus import open_hub
from proto.config import Config
from proto.membership import Lifecycle, membership
from proto.metrics import HubMetrics

LOG = logging.getLogger(__name__)


class Hub:
    """Passes on what the processes say; it keeps nothing, so it may be restarted at any time."""

    def __init__(self, config: Config, process: str) -> None:
        """Listen at the configured endpoint.

        Raises:
            UserError: it cannot listen there.
        """
        self._bus = open_hub(config.hub, config.run.name, process)
        LOG.info("listening at %s", config.hub.endpoint)

    def run(self, lifecycle: Lifecycle) -> None:
        """Serve until it should stop."""
        with self._bus, membership(self._bus, self, lifecycle):
            while not lifecycle.stopping:
                lifecycle.wait(1.0)

    def metrics(self) -> HubMetrics:
        """What it tells about itself."""
        return HubMetrics(
            id=self._bus.id,
            time_s=time.time(),
            refused=self._bus.refused,
            peers=self._bus.peers,
        )

    def checkpoint(self) -> str:
        """It has nothing to keep."""
        return "a hub keeps nothing"
