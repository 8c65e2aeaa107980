"""Receipts for what actors send: believed only if they come from a process that may give them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import ExitStack
from typing import Final

from proto.bus import Bus
from proto.keys import Role
from proto.messages import Receipt
from proto.outbox import Outbox
from proto.senders import Sender

RECEIVERS: Final = (Role.LEARNER, Role.EVALUATOR, Role.RECORDER)
"""Roles that give receipts."""


class Receipts:
    """Passes receipts on to outboxes."""

    def __init__(self, bus: Bus) -> None:
        """Listen which processes are present in the run."""
        self._bus = bus
        self._present: set[Sender] = set()
        for role in RECEIVERS:
            bus.watch_presence(role, self._on_presence(role))

    def pass_on(self, actor: str, outboxes: Iterable[Outbox]) -> ExitStack:
        """Pass the receipts for an actor on to outboxes, from now on.

        Args:
            actor: id of the actor.
            outboxes: hold its messages.

        Returns:
            Ends it when it is closed.
        """
        subscriptions = ExitStack()
        for role in RECEIVERS:
            key = self._bus.keys.receipt(role, actor)
            receive = self._on_receipt(role, outboxes)
            subscriptions.callback(self._bus.subscribe_with_sender(key, receive, Receipt))
        return subscriptions

    def _on_presence(self, role: Role) -> Callable[[str, bool], None]:
        def on_change(name: str, alive: bool) -> None:
            if alive:
                self._present.add(Sender(role, name))
            else:
                self._present.discard(Sender(role, name))

        return on_change

    def _on_receipt(
        self, role: Role, outboxes: Iterable[Outbox]
    ) -> Callable[[Receipt, Sender], None]:
        def on_receipt(receipt: Receipt, sender: Sender) -> None:
            if sender.role is not role or sender not in self._present:
                problem = f"it gives receipts of a {role}, but is none that is present in this run"
                self._bus.refuse(str(sender), problem)
                return
            for outbox in outboxes:
                if receipt.refusal:
                    outbox.refused(receipt.episode, receipt.refusal)
                else:
                    outbox.received(receipt.episode, role)

        return on_receipt
