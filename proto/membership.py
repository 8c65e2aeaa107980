"""Taking part in a run: every process on the bus is present, publishes metrics and obeys."""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Final, Protocol

from proto.bus import Bus
from proto.errors import UserError
from proto.lifecycle import Lifecycle
from proto.messages import Claim, Command, Control, ControlReply
from proto.metrics import Metrics
from proto.periodic import every

LOG = logging.getLogger(__name__)

METRICS_PERIOD_S: Final = 1.0
FROZEN_S: Final = 12.0
"""The hub drops the liveliness token of a process that has not answered for this time."""
LOOK_PERIOD_S: Final = 1.0
"""How often a process looks whether another one has its role."""
AWAY_S: Final = 8.0
"""A process that could not look for this time, because it was frozen or had no hub, may have been
replaced. Less than the time after which its token is dropped."""


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

    joined_s = time.monotonic()

    def publish_metrics() -> None:
        lifecycle.log_wait()
        metrics = replace(
            participant.metrics(),
            waiting_for=lifecycle.waiting_for[:500],
            certificate_days=_certificate_days(bus),
            running_s=time.monotonic() - joined_s,
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


@contextmanager
def alone_in_run(bus: Bus, lifecycle: Lifecycle, *, patience_s: float = FROZEN_S) -> Iterator[None]:
    """Be the only process of this role in the run, on any machine, until the context ends.

    Of processes that start at the same time one remains. A process that finds that it was replaced
    while it was frozen, or had no hub, is asked to stop. A liveliness token whose process does not
    answer, such as one that is frozen, keeps others waiting for `patience_s` at most.

    Raises:
        UserError: another process has this role.
    """
    claim = _RoleClaim(bus)
    problem = _wait_until_alone(claim, bus, lifecycle, patience_s)
    if problem:
        raise UserError(problem)

    def look() -> None:
        nonlocal problem
        if not problem and (problem := claim.problem()):
            LOG.error("stops: %s", problem)
            lifecycle.stop()

    try:
        with every(LOOK_PERIOD_S, look):
            yield
    finally:
        claim.given_up = True
    if problem:
        raise UserError(problem)


def _wait_until_alone(claim: _RoleClaim, bus: Bus, lifecycle: Lifecycle, patience_s: float) -> str:
    """Wait until this process has its role; why it will not get it, or nothing."""
    patience_over_s = time.monotonic() + patience_s
    while not lifecycle.stopping:
        if problem := claim.problem():
            return problem
        if claim.works:
            silent = bus.present(bus.role)
            if not silent:
                break
            if time.monotonic() > patience_over_s:
                LOG.warning("ignores %s, which is present but silent", ", ".join(sorted(silent)))
                break
            claim.works = False
        other = f"the end of {bus.role.with_article} that this run has already"
        lifecycle.waits_for(other if bus.peers else "the hub")
        lifecycle.wait(0.2)
    lifecycle.waits_for("")
    return ""


class _RoleClaim:
    """The claim of this process to be the only one of its role in the run.

    Every process answers the others with its claim. Each declares that it answers before it asks,
    so that of two that start at the same time one at least hears of the other.

    Attributes:
        works: whether this process has the role; false while it wants to have it.
        given_up: whether it does not want the role any more.
    """

    def __init__(self, bus: Bus) -> None:
        self.works = False
        self.given_up = False
        self._bus = bus
        self._process = secrets.token_hex(8)
        self._looked_at_s = time.monotonic()
        bus.answer(
            bus.keys.claim(bus.role), Claim, lambda _: None if self.given_up else self._now()
        )

    def problem(self) -> str:
        """Ask the others; why this process must end, or nothing. If it is alone, it works."""
        if not self._bus.peers:  # without a hub nobody can be asked
            return ""
        ours = self._now()
        answers = self._bus.ask(self._bus.keys.claim(self._bus.role), ours, Claim)
        others = [claim for claim in answers if claim.process != ours.process]
        for other in others:
            if _goes_before(other, ours):
                self.given_up = True
                return (
                    f"run {self._bus.keys.run} has {self._bus.role.with_article} already "
                    f"({other.id}): stop it, or choose another run with --set run.name=NAME"
                )
        self.works = ours.works or not others
        self._looked_at_s = time.monotonic()
        return ""

    def _now(self) -> Claim:
        was_here = time.monotonic() - self._looked_at_s < AWAY_S
        return Claim(self._bus.role, self._bus.id, self._process, self.works and was_here)


def _goes_before(other: Claim, ours: Claim) -> bool:
    """Whether another process keeps a role: the one that works, else that of the smaller id."""
    if other.works != ours.works:
        return other.works
    return other.process < ours.process


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
