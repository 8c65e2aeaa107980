"""Outboxes of actors that are gone for good: another actor of the run sends what is in them."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from actors.old_rollouts import divide_old_rollouts
from actors.receipts import Receipts
from proto.bus import Bus
from proto.errors import UserError
from proto.keys import Role
from proto.outbox import PREPARED, Outbox
from proto.run_locks import only_one

LOG = logging.getLogger(__name__)

LOOK_EVERY_S: Final = 30.0
GONE_AFTER_S: Final = 60.0
"""An actor that was away for so long is gone for good; one that is restarted is back before."""
OUTBOXES: Final = ("sequences", "rollouts", "outcomes")


class LeftOutboxes:
    """Sends the messages of actors whose processes do not run any more, as in a run that moved.

    Should such an actor come back nevertheless, both send its messages. The receivers store each
    once, and the receipts delete them.
    """

    def __init__(
        self, run_folder: Path, bus: Bus, receipts: Receipts, *, gone_after_s: float = GONE_AFTER_S
    ) -> None:
        """Look in a run's folder for the outboxes of others.

        Args:
            run_folder: the run's folder.
            bus: sends the messages.
            receipts: the receipts for them.
            gone_after_s: how long an actor must have been away (s).
        """
        self._run_folder = run_folder
        self._bus = bus
        self._receipts = receipts
        self._gone_after_s = gone_after_s
        self._away_since_s: dict[str, float] = {}
        self._held: dict[str, tuple[ExitStack, list[Outbox]]] = {}

    def __len__(self) -> int:
        return sum(len(outbox) for _, outboxes in self._held.values() for outbox in outboxes)

    def look(self) -> None:
        """Find outboxes, send what is due, and let go of those that are empty."""
        folders = (self._run_folder / "outbox").glob("*")
        kept = ("*/*.message", f"*/*{PREPARED}")
        others = {each.name for each in folders if any(any(each.glob(name)) for name in kept)}
        others -= {self._bus.id, *self._held}
        if others:
            others -= self._bus.present(Role.ACTOR)
        now_s = time.monotonic()
        self._away_since_s = {name: self._away_since_s.get(name, now_s) for name in others}
        for name, since_s in sorted(self._away_since_s.items()):
            if now_s - since_s >= self._gone_after_s:
                self._take(name)
        for name, (lock, outboxes) in list(self._held.items()):
            for outbox in outboxes:
                outbox.send_due()
            if not any(map(len, outboxes)):
                del self._held[name]
                lock.close()

    def close(self) -> None:
        """Let go of all outboxes."""
        for lock, _ in self._held.values():
            lock.close()

    def _take(self, name: str) -> None:
        folder = self._run_folder / "outbox" / name
        lock = ExitStack()
        try:
            lock.enter_context(only_one(self._run_folder, Role.WATCH, f"left-{name}"))
            with only_one(self._run_folder, Role.ACTOR, name):
                divide_old_rollouts(folder)
                outboxes = [Outbox(folder / each, self._send_as(name)) for each in OUTBOXES]
        except UserError:  # its process runs on this machine, or another actor sends them
            lock.close()
            return
        lock.enter_context(self._receipts.pass_on(name, outboxes))
        self._held[name] = lock, outboxes
        LOG.info("sends the %d messages that actor %s left behind", sum(map(len, outboxes)), name)

    def _send_as(self, name: str) -> Callable[..., None]:
        return lambda key, wire: self._bus.deliver_wire(self._bus.keys.renamed(key, name), wire)
