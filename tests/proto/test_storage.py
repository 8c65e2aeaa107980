"""Files are written completely or not at all, lines are synced, a full disk is reported."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from proto.errors import UserError
from proto.storage import (
    DiskFullError,
    append_line,
    change_suffix,
    drop_unfinished_line,
    link_file,
    make_folder,
    parts_in,
    storage_errors,
    written_whole,
)


def write(path: Path, content: bytes) -> None:
    with written_whole(path) as stream:
        stream.write(content)


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Paths that were synced to disk, in order."""
    paths: list[str] = []
    fsync = os.fsync

    def note(descriptor: int) -> None:
        fsync(descriptor)
        paths.append(str(Path(f"/proc/self/fd/{descriptor}").readlink()))

    monkeypatch.setattr(os, "fsync", note)
    return paths


def test_a_file_is_complete_or_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / "file"
    write(path, b"first")
    with pytest.raises(TypeError), written_whole(path) as stream:
        stream.writelines([b"sec", "ond"])  # type: ignore[list-item]
    assert path.read_bytes() == b"first"
    assert list(path.parent.iterdir()) == [path]
    with written_whole(path) as stream:
        stream.write(b"second")
        stream.flush()
        assert [part.read_bytes() for part in parts_in(path.parent)] == [b"second"]
        assert path.read_bytes() == b"first"
    assert path.read_bytes() == b"second"


def test_files_lines_and_folders_are_synced(tmp_path: Path, synced: list[str]) -> None:
    make_folder(tmp_path / "a" / "b")
    assert sorted(synced) == [str(tmp_path), str(tmp_path / "a")]
    synced.clear()
    write(tmp_path / "file", b"content")
    assert synced[0].startswith(str(tmp_path / "file."))
    assert synced[1:] == [str(tmp_path)]
    synced.clear()
    append_line(tmp_path / "log", b"1\n")
    append_line(tmp_path / "log", b"2\n")
    assert synced == [str(tmp_path / "log"), str(tmp_path), str(tmp_path / "log")]
    synced.clear()
    change_suffix(tmp_path / "file", ".refused")
    assert synced == [str(tmp_path)]


def test_an_incomplete_last_line_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "log" / "lines"
    assert not drop_unfinished_line(path)
    append_line(path, b"one\n")
    append_line(path, b"two\n")
    assert path.read_bytes() == b"one\ntwo\n"
    assert not drop_unfinished_line(path)
    path.write_bytes(b"one\ntwo\nthr")
    assert drop_unfinished_line(path)
    assert path.read_bytes() == b"one\ntwo\n"


def test_a_full_disk_is_reported_and_changes_nothing(tiny_disk: Path) -> None:
    log, file = tiny_disk / "log", tiny_disk / "file"
    append_line(log, b"one\n")
    write(file, b"small")
    full = f"the file system {tiny_disk} is full .* free some space"
    with pytest.raises(DiskFullError, match=full):
        write(file, bytes(1_000_000))
    with pytest.raises(DiskFullError, match=full):
        append_line(log, bytes(1_000_000) + b"\n")
    assert file.read_bytes() == b"small"
    assert log.read_bytes() == b"one\n"
    assert sorted(path.name for path in tiny_disk.iterdir()) == ["file", "log"]


@pytest.mark.parametrize(
    ("number", "said"), [(errno.ENOSPC, "is full"), (errno.EDQUOT, "quota on the file system")]
)
def test_missing_disk_space_raises_its_own_error(tmp_path: Path, number: int, said: str) -> None:
    with pytest.raises(DiskFullError, match=said), storage_errors(tmp_path / "file"):
        raise OSError(number, os.strerror(number))


def test_a_folder_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    path = tmp_path / "file" / "more"
    for attempt in (lambda: write(path, b""), lambda: append_line(path, b"\n")):
        with pytest.raises(UserError, match=rf"{tmp_path / 'file'} cannot be written"):
            attempt()
    with pytest.raises(UserError, match="cannot be written: No such file"):
        change_suffix(tmp_path / "missing", ".other")


def test_a_second_name_is_given_again_and_again(tmp_path: Path) -> None:
    """Also when a process was killed before it replaced the file itself."""
    path, other = tmp_path / "file", tmp_path / "other"
    path.write_bytes(b"old")
    link_file(path, other)
    link_file(path, other)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["file", "other"]
    with written_whole(path) as stream:
        stream.write(b"new")
    assert other.read_bytes() == b"old"
