"""An action that is repeated in the background."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

LOG = logging.getLogger(__name__)


@contextmanager
def every(period_s: float, action: Callable[[], None]) -> Iterator[None]:
    """Repeat an action in a thread of its own until the context ends.

    An exception in the action is logged; the action is repeated all the same.
    """
    over = threading.Event()

    def repeat() -> None:
        while not over.wait(period_s):
            try:
                action()
            except Exception:
                LOG.exception("an action that is repeated every %s s failed", period_s)

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
