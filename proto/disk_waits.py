"""Waiting for a disk that is full, or that cannot be written for the moment."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Final, TypeVar

from proto.lifecycle import Lifecycle
from proto.storage import StorageError

LOG = logging.getLogger(__name__)

TRY_AGAIN_S: Final = 2.0

Result = TypeVar("Result")


def when_disk_allows(lifecycle: Lifecycle, write: Callable[[], Result]) -> Result:
    """Do something that writes to disk; wait and do it again as long as the disk does not allow it.

    The problem is logged once, and again when writing goes on.

    Args:
        lifecycle: of this process, which says in its metrics that it waits for the disk.
        write: what to do; it must be possible to do it again after it has failed.

    Returns:
        What `write` returned.

    Raises:
        StorageError: the process was asked to stop, and it still cannot be written.
    """
    before, told = lifecycle.waiting_for, ""
    while True:
        try:
            result = write()
        except StorageError as error:
            if lifecycle.stopping:
                raise
            if not told:
                LOG.warning("%s. Waiting; nothing is lost as long as this process lives", error)
            told = str(error)
            lifecycle.waits_for("the disk: " + told)
            lifecycle.wait(TRY_AGAIN_S)
        else:
            if told:
                LOG.info("writing goes on")
                lifecycle.waits_for(before)
            return result
