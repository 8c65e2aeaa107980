"""The folder of the cache."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from proto.cache import cache_folder, writable_by_others


def test_the_cache_folder_comes_from_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VMDNN_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path


@pytest.mark.parametrize("value", [None, ""])
def test_by_default_the_cache_is_in_the_home_folder(
    value: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    if value is None:
        monkeypatch.delenv("VMDNN_CACHE", raising=False)
    else:
        monkeypatch.setenv("VMDNN_CACHE", value)
    assert cache_folder() == tmp_path / ".cache" / "vmdnn"


def test_what_others_can_write_is_found(tmp_path: Path) -> None:
    folder, file = tmp_path / "folder", tmp_path / "folder" / "file"
    assert writable_by_others(file) == ""
    folder.mkdir(mode=0o700)
    file.write_text("")
    file.chmod(0o600)
    assert writable_by_others(file) == ""
    file.chmod(0o606)
    assert writable_by_others(file) == f"everyone can write to {file}"
    file.chmod(0o600)
    folder.chmod(0o777)
    assert writable_by_others(file) == f"everyone can write to {folder}"
    folder.chmod(0o1777)  # such as /tmp: only the owner can replace a file
    assert writable_by_others(file) == ""


def test_a_link_is_as_safe_as_where_it_leads(tmp_path: Path) -> None:
    open_folder = tmp_path / "open"
    open_folder.mkdir()
    open_folder.chmod(0o777)
    (tmp_path / "link").symlink_to(open_folder)
    assert writable_by_others(tmp_path / "link") == f"everyone can write to {open_folder}"


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file to another user")
def test_what_belongs_to_another_user_is_found(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    os.chown(file, 12345, 12345)
    assert writable_by_others(file) == f"{file} belongs to another user (12345)"
