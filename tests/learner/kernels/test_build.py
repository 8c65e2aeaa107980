"""Which compiled library is used."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from learner.kernels import build


def test_a_library_that_others_could_have_written_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    library = build.find_or_compile()
    shared, own = tmp_path / "shared", tmp_path / "own"
    for folder in (shared, own):
        folder.mkdir()
        shutil.copy(library, folder / library.name)
    monkeypatch.setenv("VMDNN_CACHE", str(shared))
    monkeypatch.setattr(build, "FOLDER", tmp_path)
    monkeypatch.setattr(build, "library_name", lambda: library.name)
    monkeypatch.setattr(build, "private_folder", lambda: own)
    assert build.find_or_compile() == shared / library.name
    shared.chmod(0o777)
    assert build.find_or_compile() == own / library.name
    assert f"{shared / library.name} is not used: everyone can write to {shared}" in caplog.text


def test_without_a_safe_folder_nothing_is_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tmp_path.chmod(0o777)
    monkeypatch.setenv("VMDNN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(build, "FOLDER", tmp_path)
    monkeypatch.setattr(build, "library_name", lambda: "kernels.so")
    monkeypatch.setattr(build, "private_folder", lambda: tmp_path / "private")
    with pytest.raises(build.NotCompiledError, match=f"everyone can write to {tmp_path}"):
        build.find_or_compile()
    assert list(tmp_path.iterdir()) == []
