"""Files that are either whole or not there."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from proto.errors import UserError


@contextmanager
def written_whole(path: Path) -> Iterator[BinaryIO]:
    """Write a file under a temporary name; it gets its own name once it is whole and on disk.

    Folders that are missing are made. If the writing fails, what was at `path` stays as it was and
    nothing else is left. A killed process leaves `NAME.<random>.part`, which `parts_in` finds.

    Raises:
        UserError: the file cannot be written there.
    """
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("xb") as stream, _removed_if_it_fails(part):
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
            part.replace(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error}") from error


def parts_in(folder: Path) -> list[Path]:
    """Temporary files that killed processes left in a folder; only for a folder none writes to."""
    return sorted(folder.glob("*.part"))


@contextmanager
def _removed_if_it_fails(part: Path) -> Iterator[None]:
    try:
        yield
    except BaseException:
        part.unlink(missing_ok=True)
        raise
