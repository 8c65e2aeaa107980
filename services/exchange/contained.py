"""Reads data of others in a process of its own, whose memory and time are limited.

A page of a Parquet file, or a picture of a video, may become any size when it is unpacked, and the
libraries that unpack it have no limits. A process has.
"""

from __future__ import annotations

import multiprocessing
import resource
import signal
import threading
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Concatenate, Final, ParamSpec, TypeVar

from proto.errors import UserError
from services.playing.parent import end_with_parent

LEAST_MEMORY: Final = 512 * 2**20
MEMORY_PER_BYTE: Final = 8
"""Memory for a data set: the least, and so much for each byte of its largest file."""
PATIENCE_S: Final = 120.0
PATIENCE_PER_MIB_S: Final = 2.0
"""Time until the next item: the least, and so much for each MiB of the largest file."""

Item = TypeVar("Item")
Arguments = ParamSpec("Arguments")


def contained(
    read: Callable[Concatenate[Path, Arguments], Iterator[Item]],
    folder: Path,
    *arguments: Arguments.args,
    **named: Arguments.kwargs,
) -> Iterator[Item]:
    """Yield what a function yields that reads a data set; it is called in another process.

    Args:
        read: a function of a module; called with the folder and the other arguments.
        folder: the data set.
        arguments: its other arguments.
        named: its other arguments by name.

    Raises:
        UserError: `read` raised it, or needs too much memory or time, or ended its process.
    """
    files = (path for path in folder.rglob("*") if path.is_file())
    largest = max((path.stat().st_size for path in files), default=0)
    patience_s = PATIENCE_S + PATIENCE_PER_MIB_S * largest / 2**20
    context = multiprocessing.get_context("spawn")
    received, sent = context.Pipe(duplex=False)
    process = context.Process(
        target=_read,
        args=(sent, LEAST_MEMORY + MEMORY_PER_BYTE * largest, read, folder, arguments, named),
        daemon=True,
    )
    process.start()
    sent.close()
    try:
        while True:
            if not received.poll(patience_s):
                raise UserError(
                    f"{folder} takes too long to read: nothing came within {patience_s:.0f} s"
                )
            items = received.recv()
            if isinstance(items, UserError):
                raise items
            if not items:
                return
            yield from items
    except (EOFError, OSError) as error:
        raise UserError(
            f"{folder} is damaged, or needs too much memory: the process that read it has ended"
        ) from error
    finally:
        process.kill()
        process.join()
        received.close()


def _read(
    sent: Connection,
    memory: int,
    read: Callable[..., Iterator[object]],
    folder: Path,
    arguments: tuple[object, ...],
    named: dict[str, object],
) -> None:
    """Send each item as a tuple, then an empty tuple; or the UserError."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent as well
    threading.Thread(target=end_with_parent, daemon=True).start()
    limit = _data_bytes() + memory
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        for item in read(folder, *arguments, **named):
            sent.send((item,))
    except UserError as error:
        sent.send(UserError(str(error)))
    else:
        sent.send(())


def _data_bytes() -> int:
    """What the limit counts of this process now: memory of its own that it may write to."""
    status = Path("/proc/self/status").read_text()
    (line,) = (line for line in status.splitlines() if line.startswith("VmData"))
    return int(line.split()[1]) * 1024
