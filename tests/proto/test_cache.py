"""The folder of the cache."""

from __future__ import annotations

from pathlib import Path

import pytest

from proto.cache import cache_folder


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
