"""What a process that reads foreign data may do; light, because that process imports it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

from proto.errors import UserError


def read_numbers(folder: Path, last: int) -> Iterator[int]:
    """Yield 1; then end with 2, raise an error, die, or go on for ever."""
    assert folder.is_dir()
    yield 1
    if last == 2:
        yield 2
    elif last == 3:
        raise UserError("there is no third one")
    elif last == 4:
        os.kill(os.getpid(), signal.SIGSEGV)
    else:
        time.sleep(600)
