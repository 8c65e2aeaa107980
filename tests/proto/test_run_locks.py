"""Each id has one process, and the lock of a dead process is free."""

from __future__ import annotations

import errno
import fcntl
import subprocess
import sys
from pathlib import Path

import pytest

from proto.errors import UserError
from proto.keys import Role
from proto.run_locks import only_one, own_id, owned_training, single_process


def test_ids_are_free_names_of_this_host(tmp_path: Path) -> None:
    with own_id(tmp_path, Role.ACTOR, None) as first, own_id(tmp_path, Role.ACTOR, None) as second:
        assert first.endswith("-1")
        assert second.endswith("-2")
        with own_id(tmp_path, Role.RECORDER, None) as other_role:
            assert other_role == first
    with own_id(tmp_path, Role.ACTOR, None) as again:
        assert again == first


def test_a_requested_id_is_refused_while_it_is_used(tmp_path: Path) -> None:
    with own_id(tmp_path, Role.ACTOR, "a") as taken:
        assert taken == "a"
        refused = pytest.raises(UserError, match="an actor with the id 'a' already works")
        with refused, only_one(tmp_path, Role.ACTOR, "a"):
            pass
    with own_id(tmp_path, Role.ACTOR, "a"):
        pass


def test_a_killed_process_frees_its_id(tmp_path: Path) -> None:
    script = (
        "import pathlib, sys, time\n"
        "from proto.run_locks import own_id\n"
        f"with own_id(pathlib.Path({str(tmp_path)!r}), 'actor', 'mortal'):\n"
        "    print('mine', flush=True)\n"
        "    time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"mine\n"
        with pytest.raises(UserError), only_one(tmp_path, Role.ACTOR, "mortal"):
            pass
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    with only_one(tmp_path, Role.ACTOR, "mortal"):
        pass


def test_a_single_process_locks_the_folder_whatever_its_id(tmp_path: Path) -> None:
    with single_process(tmp_path, Role.LEARNER, None) as name:
        assert name == "learner"
        refused = pytest.raises(UserError, match=r"a learner .* already works in")
        with refused, single_process(tmp_path, Role.LEARNER, "another"):
            pass
        with single_process(tmp_path, Role.EVALUATOR, "mine") as other_role:
            assert other_role == "mine"


def test_nobody_trains_in_the_folder_of_a_learner(tmp_path: Path) -> None:
    with single_process(tmp_path, Role.LEARNER, "mine"):
        refused = pytest.raises(UserError, match=f"another process trains in {tmp_path} already")
        with refused, owned_training(tmp_path):
            pass
    with owned_training(tmp_path):
        refused = pytest.raises(UserError, match="a learner")
        with refused, single_process(tmp_path, Role.LEARNER, None):
            pass


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(UserError, match="cannot be written"),
        own_id(tmp_path / "file", Role.ACTOR, None),
    ):
        pass


def test_a_file_system_without_locks_is_told_and_stops_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with only_one(tmp_path, Role.LEARNER, "learner"):
        assert "cannot be locked (Function not implemented)" in caplog.text
