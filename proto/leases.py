"""Work that is handed out, and handed out again when its holder is too late or has vanished."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

Item = TypeVar("Item", bound=Hashable)


@dataclass(frozen=True)
class _Lease:
    holder: str
    until_s: float


class Leases(Generic[Item]):
    """Who works on which item, until when. Used by several threads."""

    def __init__(self, lease_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._lease_s = lease_s
        self._clock = clock
        self._lock = threading.Lock()
        self._leases: dict[Item, _Lease] = {}

    def __len__(self) -> int:
        with self._lock:
            self._drop(lambda lease: lease.until_s <= self._clock())
            return len(self._leases)

    def take(self, holder: str, wanted: Iterable[Item]) -> Item | None:
        """Lease the first of the wanted items that nobody holds; None if all are held."""
        with self._lock:
            self._drop(lambda lease: lease.until_s <= self._clock())
            item = next((item for item in wanted if item not in self._leases), None)
            if item is not None:
                self._leases[item] = _Lease(holder, self._clock() + self._lease_s)
            return item

    def holder(self, item: Item) -> str | None:
        """Return who holds an item; None if nobody does."""
        with self._lock:
            self._drop(lambda lease: lease.until_s <= self._clock())
            lease = self._leases.get(item)
            return None if lease is None else lease.holder

    def finish(self, item: Item, holder: str | None = None) -> None:
        """End the lease of an item, because it is done or has failed.

        Args:
            item: the item.
            holder: end the lease only if it is this one's; None: whoever has it.
        """
        with self._lock:
            lease = self._leases.get(item)
            if lease is not None and holder in (None, lease.holder):
                del self._leases[item]

    def release(self, holder: str) -> None:
        """End all leases of a holder that has vanished."""
        with self._lock:
            self._drop(lambda lease: lease.holder == holder)

    def _drop(self, over: Callable[[_Lease], bool]) -> None:
        self._leases = {item: lease for item, lease in self._leases.items() if not over(lease)}
