"""Sequences that cannot be recorded: their simulation fails, or kills the actor, every time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from typing import Final, Generic, Protocol, TypeVar

from proto.episode import Kind
from proto.leases import Leases
from proto.messages import EpisodeFailed
from proto.suites import Conditions

TRIES: Final = 3
"""After so many failures a sequence is not asked for any more."""

Item = TypeVar("Item", bound=Hashable)


class Shown(Protocol):
    """What tells one sequence from another: an episode, its summary, or a report that it failed."""

    @property
    def kind(self) -> Kind:
        """Why it was played."""

    @property
    def task(self) -> str:
        """Name of the task."""

    @property
    def seed(self) -> int:
        """Seed of the episode."""

    @property
    def conditions(self) -> Conditions | None:
        """The conditions of the suite that it belongs to."""

    @property
    def training(self) -> str:
        """Id of the training that the policy comes from, empty for the tutor."""

    @property
    def policy_version(self) -> int:
        """Version of the policy, 0 for the tutor."""


class Failures(Generic[Item]):
    """Counts how often each item failed.

    An actor that died reports its failure after its lease has ended, so each request is noted here.
    """

    def __init__(self) -> None:
        self._reports: dict[Item, set[str]] = {}
        self._asked: Counter[tuple[Item, str]] = Counter()

    def ask(self, item: Item, actor: str) -> None:
        """Note that an actor was asked for an item, so that it may report a failure of it once."""
        self._asked[item, actor] += 1

    def take_request(self, item: Item, actor: str) -> bool:
        """Whether an actor was asked for an item and has not reported this request's failure."""
        if not self._asked[item, actor]:
            return False
        self._asked[item, actor] -= 1
        return True

    def fail(self, item: Item, report: EpisodeFailed, leases: Leases[Item]) -> bool:
        """Count a report of a failure and end the actor's lease; whether the item had all TRIES.

        The report of an actor that was not asked, or that was counted before, is ignored.
        """
        if self.counts(item, report.id) or not self.take_request(item, report.actor):
            return False
        leases.finish(item, report.actor)
        return self.add(item, report.id)

    def counts(self, item: Item, report: str) -> bool:
        """Whether a report of an item was counted before; it may come again, late."""
        return report in self._reports.get(item, ())

    def add(self, item: Item, report: str) -> bool:
        """Count a failure of an item; whether the item has had all its TRIES.

        Args:
            item: what failed.
            report: id of the report; the same report counts once.
        """
        reports = self._reports.setdefault(item, set())
        reports.add(report)
        return len(reports) >= TRIES
