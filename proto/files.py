"""Files that are either whole or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final

from proto.errors import UserError

PART_SUFFIX: Final = ".part"
"""What a file is called, after its own name, while it is being written."""


def part_of(path: Path) -> Path:
    """Temporary name under which `path` is written."""
    return path.with_name(path.name + PART_SUFFIX)


@contextmanager
def written_whole(path: Path) -> Iterator[BinaryIO]:
    """Write a file under its temporary name; it gets its own name once it is whole and on disk.

    Folders that are missing are made. If the writing fails, what was at `path` stays as it was and
    nothing else is left; a killed process leaves the temporary file.

    Raises:
        UserError: the file cannot be written there.
    """
    part = part_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as stream, _removed_if_it_fails(part):
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
            part.replace(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error}") from error


@contextmanager
def _removed_if_it_fails(part: Path) -> Iterator[None]:
    try:
        yield
    except BaseException:
        part.unlink(missing_ok=True)
        raise
