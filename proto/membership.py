"""Taking part in a run: every process on the bus is present, publishes metrics and obeys."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Final, Protocol

from proto.bus import Bus
from proto.errors import UserError
from proto.lifecycle import Lifecycle
from proto.messages import Command, Control, ControlReply
from proto.metrics import METRICS, Metrics
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
        lifecycle.log_wait()
        metrics = replace(
            participant.metrics(),
            waiting_for=lifecycle.waiting_for[:500],
            certificate_days=_certificate_days(bus),
        )
        bus.publish(bus.keys.metrics(bus.role, bus.id), metrics)

    bus.answer(bus.keys.control(bus.role), Control, on_control)
    bus.announce()
    if bus.certificate is not None and bus.certificate.expires_soon:
        LOG.warning(bus.certificate.expiry_words)
    with every(METRICS_PERIOD_S, publish_metrics):
        yield
    try:
        publish_metrics()  # the final state
    except Exception:
        LOG.exception("the last metrics could not be published")


def alone_in_run(bus: Bus, lifecycle: Lifecycle, *, patience_s: float = FROZEN_S) -> None:
    """Check, across all machines, that no other process of the run has this one's role.

    A predecessor that froze keeps its liveliness token for FROZEN_S; so long this one waits. A
    token whose owner publishes no metrics in this time does not count.

    Raises:
        UserError: another process has this role.
    """
    heard: set[str] = set()
    patience_over_s = time.monotonic() + patience_s
    listening = False
    while (others := bus.present(bus.role)) and not lifecycle.stopping:
        if not listening:
            bus.subscribe(bus.keys.metrics(bus.role), lambda m: heard.add(m.id), *METRICS)
            listening = True
        if time.monotonic() > patience_over_s:
            if living := others & heard:
                raise UserError(
                    f"run {bus.keys.run} has {bus.role.with_article} already "
                    f"({', '.join(sorted(living))}): "
                    "stop it, or choose another run with --set run.name=NAME"
                )
            LOG.warning("ignores %s, which is present but silent", ", ".join(sorted(others)))
            return
        lifecycle.waits_for(f"the end of {bus.role.with_article} that this run has already")
        lifecycle.wait(0.2)
    lifecycle.waits_for("")


def _certificate_days(bus: Bus) -> int | None:
    """Days until the certificate expires, if that is soon."""
    certificate = bus.certificate
    return certificate.days_left if certificate is not None and certificate.expires_soon else None


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
