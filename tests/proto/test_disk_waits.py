"""A process waits for a disk that is full, says so once, and goes on when there is room."""

from __future__ import annotations

import logging
import threading
from pathlib import Path

import pytest
from processes import eventually

from proto import disk_waits
from proto.disk_waits import when_disk_allows
from proto.lifecycle import Lifecycle
from proto.storage import DiskFullError, StorageError, append_line


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk_waits, "TRY_AGAIN_S", 0.02)


def test_it_goes_on_when_there_is_room(tiny_disk: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    filler, log = tiny_disk / "filler", tiny_disk / "log"
    append_line(log, b"before\n")
    with pytest.raises(DiskFullError):
        append_line(filler, bytes(1 << 20))
    filler.write_bytes(bytes(60 * 1024 - 4096 * 2))
    lifecycle = Lifecycle()
    lifecycle.waits_for("a trial")
    line = b"x" * 20_000 + b"\n"
    writer = threading.Thread(
        target=when_disk_allows, args=(lifecycle, lambda: append_line(log, line))
    )
    writer.start()
    eventually(lambda: "is full" in lifecycle.waiting_for, "it says what it waits for")
    filler.unlink()
    writer.join(10)
    assert not writer.is_alive()
    assert log.read_bytes() == b"before\n" + line
    assert lifecycle.waiting_for == "a trial"
    warnings = [record for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warnings) == 1, "it says so once"
    assert "writing goes on" in caplog.text


def test_it_gives_up_when_it_should_stop(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    lifecycle = Lifecycle()
    threading.Timer(0.1, lifecycle.stop).start()
    with pytest.raises(StorageError):
        when_disk_allows(lifecycle, lambda: append_line(tmp_path / "file" / "log", b"line\n"))
