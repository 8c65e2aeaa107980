"""Taking part in a run: every process on the bus is present, publishes metrics and obeys."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final, Protocol

from proto.bus import Bus
from proto.errors import UserError
from proto.lifecycle import Lifecycle
from proto.messages import Command, Control, ControlReply
from proto.metrics import Metrics
from proto.periodic import every

LOG = logging.getLogger(__name__)

METRICS_PERIOD_S: Final = 1.0
FROZEN_S: Final = 12.0
"""The hub drops the liveliness token of a process that has not answered for this time."""


class Participant(Protocol):
    """A process on the bus, as the others see it."""

    def metrics(self) -> Metrics:
        """Metrics at this moment; called about once a second from another thread."""

    def checkpoint(self) -> str:
        """Write to disk what a restart needs; gives a sentence that says what was written."""


@contextmanager
def membership(bus: Bus, participant: Participant, lifecycle: Lifecycle) -> Iterator[None]:
    """Be present, publish metrics and answer control messages until the context ends."""

    def on_control(control: Control) -> ControlReply:
        return ControlReply(bus.role, bus.id, _obey(control.command, participant, lifecycle))

    def publish_metrics() -> None:
        bus.publish(bus.keys.metrics(bus.role, bus.id), participant.metrics())

    bus.answer(bus.keys.control(bus.role), Control, on_control)
    bus.announce()
    with every(METRICS_PERIOD_S, publish_metrics):
        yield
    try:
        publish_metrics()  # the final state
    except Exception:
        LOG.exception("the last metrics could not be published")


def alone_in_run(bus: Bus, lifecycle: Lifecycle, *, patience_s: float = FROZEN_S) -> None:
    """Check, across all machines, that no other process of the run has this one's role.

    A predecessor that froze keeps its liveliness token for FROZEN_S; so long this one waits.

    Raises:
        UserError: another process has this role.
    """
    patience_over_s = time.monotonic() + patience_s
    while (others := bus.present(bus.role)) and not lifecycle.stopping:
        if time.monotonic() > patience_over_s:
            raise UserError(
                f"run {bus.keys.run} has {bus.role.with_article} already "
                f"({', '.join(sorted(others))}): "
                "stop it, or choose another run with --set run.name=NAME"
            )
        lifecycle.wait(0.2)


def _obey(command: Command, participant: Participant, lifecycle: Lifecycle) -> str:
    match command:
        case Command.PAUSE:
            lifecycle.pause()
            return "paused"
        case Command.RESUME:
            lifecycle.resume()
            return "resumed"
        case Command.CHECKPOINT:
            return participant.checkpoint()
        case Command.STOP:
            lifecycle.stop()
            return "stopping"
