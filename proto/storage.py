"""All writing to disk: whole files and appended lines, on disk when a function returns.

Nothing else in the project opens a file for writing; tests/test_architecture.py checks it. After a
file was made or renamed its folder is synced as well, so that a power failure does not undo it.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final

from proto.errors import UserError

_FULL: Final = (errno.ENOSPC, errno.EDQUOT)


class StorageError(UserError):
    """A file cannot be written. This may pass: a process that runs waits until it can."""


class DiskFullError(StorageError):
    """A file cannot be written because its file system, or the user's quota on it, is full."""


@contextmanager
def written_whole(path: Path, *, mode: int = 0o666) -> Iterator[BinaryIO]:
    """Write a file under a temporary name; it gets its own name once it is whole and on disk.

    Missing folders are made. If the writing fails, the file at `path` stays as it was and nothing
    else is left. A killed process leaves `NAME.<random>.part`, which `parts_in` finds.

    Args:
        path: the file.
        mode: permissions with which it is made, less those of the umask.

    Raises:
        DiskFullError: no space is left.
        StorageError: the file cannot be written for another reason.
    """
    make_folder(path.parent)
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    with storage_errors(path):
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(descriptor, "wb") as stream, _removed_if_it_fails(part):
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
            part.replace(path)
        _sync_folder(path.parent)


def parts_in(folder: Path) -> list[Path]:
    """Temporary files that killed processes left in a folder; only for a folder none writes to."""
    return sorted(folder.glob("*.part"))


def append_line(path: Path, line: bytes) -> None:
    """Append a line, or several, to a file; the last one ends with a newline. See `append`.

    A killed process or a power failure may leave an unfinished last line, which
    `drop_unfinished_line` removes.

    Raises:
        DiskFullError: no space is left.
        StorageError: the file cannot be written for another reason.
    """
    append(path, line)


def append(path: Path, content: bytes) -> None:
    """Append to a file. A missing file is made.

    If the writing fails, the file stays as it was. A killed process or a power failure may leave a
    part of the content.

    Raises:
        DiskFullError: no space is left.
        StorageError: the file cannot be written for another reason.
    """
    make_folder(path.parent)
    with storage_errors(path), path.open("ab", buffering=0) as stream:
        size = stream.seek(0, os.SEEK_END)
        try:
            _write_all(stream, content)
            os.fsync(stream.fileno())
        except OSError:
            stream.truncate(size)
            raise
        if size == 0:
            _sync_folder(path.parent)


def drop_unfinished_line(path: Path) -> bool:
    """Remove what stands after a file's last newline; whether there was anything.

    A missing file is left missing.

    Raises:
        StorageError: the file cannot be written.
    """
    if not path.exists():
        return False
    with storage_errors(path), path.open("r+b") as stream:
        content = stream.read()
        whole = content.rfind(b"\n") + 1
        if whole == len(content):
            return False
        stream.truncate(whole)
        os.fsync(stream.fileno())
        return True


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, where they are missing.

    Raises:
        DiskFullError: no space is left.
        StorageError: it cannot be made for another reason.
    """
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for made in missing:
            _sync_folder(made.parent)


def link_file(path: Path, other: Path) -> None:
    """Make `other` a second name of a file, which keeps its content when `path` is replaced.

    On a file system without links it becomes a copy.

    Raises:
        DiskFullError: no space is left.
        StorageError: it cannot be made for another reason.
    """
    part = other.with_name(f"{other.name}.{secrets.token_hex(4)}.part")
    with storage_errors(other):
        try:
            os.link(path, part)
        except OSError:
            with written_whole(other) as stream, path.open("rb") as source:
                shutil.copyfileobj(source, stream)
            return
        part.replace(other)
        part.unlink(missing_ok=True)  # it stays if `other` was this file's second name before
        _sync_folder(other.parent)


def delete_file(path: Path) -> None:
    """Delete a file; a missing one is ignored.

    Raises:
        StorageError: it cannot be deleted.
    """
    with storage_errors(path):
        path.unlink(missing_ok=True)


def change_suffix(path: Path, suffix: str) -> Path:
    """Rename a file so that its name ends with another suffix; gives the new path.

    Raises:
        StorageError: there is no such file, or it cannot be renamed.
    """
    renamed = path.with_suffix(suffix)
    rename(path, renamed)
    return renamed


def rename(path: Path, renamed: Path) -> None:
    """Give a file or a folder another name.

    Raises:
        StorageError: it does not exist, or cannot be renamed.
    """
    with storage_errors(renamed):
        path.rename(renamed)
        _sync_folder(renamed.parent)


@contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn an error of the file system while `path` is written into one for the user.

    Raises:
        DiskFullError: no space is left.
        StorageError: the file cannot be written for another reason.
    """
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise DiskFullError(_full_words(path, error)) from error
        raise StorageError(
            f"{path} cannot be written: {error.strerror or error}; check that the folder exists "
            "and that you may write there, or choose another one"
        ) from error


def _full_words(path: Path, error: OSError) -> str:
    mount = _mount_point(path)
    if error.errno == errno.EDQUOT:
        return (
            f"{path} cannot be written: your disk quota on the file system {mount} is used up; "
            "delete files of yours there, or choose a folder on another file system"
        )
    free = shutil.disk_usage(mount).free
    return (
        f"{path} cannot be written: the file system {mount} is full ({free / 1e6:.1f} MB free); "
        "free some space there, or choose a folder on another file system"
    )


def _mount_point(path: Path) -> Path:
    place = path.absolute()
    return next(parent for parent in (place, *place.parents) if os.path.ismount(parent))


def _write_all(stream: BinaryIO, content: bytes) -> None:
    """Write all of it to an unbuffered file, which may take less than all in one call."""
    rest = memoryview(content)
    while rest:
        rest = rest[stream.write(rest) :]


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _removed_if_it_fails(part: Path) -> Iterator[None]:
    try:
        yield
    except BaseException:
        part.unlink(missing_ok=True)
        raise
