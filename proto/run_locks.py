"""File locks in a run's folder: no two processes on this machine are the same participant."""

from __future__ import annotations

import fcntl
import itertools
import logging
import re
import socket
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from proto.errors import UserError
from proto.keys import Role
from proto.storage import make_folder, storage_errors

LOG = logging.getLogger(__name__)


class AlreadyWorksError(UserError):
    """Another process of a role works in the folder of a run."""


@contextmanager
def owned_run(run_folder: Path) -> Iterator[None]:
    """Hold the lock of whoever starts the processes of a run, until the context ends.

    Raises:
        UserError: the run is being played already.
    """
    with _lock(run_folder, "run_local") as held:
        if not held:
            raise UserError(
                f"the run in {run_folder} is being played already: stop it, or choose another "
                "run with --set run.name=NAME"
            )
        yield


@contextmanager
def only_one(run_folder: Path, role: Role, name: str) -> Iterator[None]:
    """Hold the lock of a role and a name in a run's folder until the context ends.

    Raises:
        AlreadyWorksError: another process holds it.
    """
    with _lock(run_folder, f"{role}-{name}") as held:
        if not held:
            raise AlreadyWorksError(
                f"{role.with_article} with the id {name!r} already works in {run_folder}: stop it, "
                "or choose another --id or run"
            )
        yield


@contextmanager
def single_process(run_folder: Path, role: Role, wanted: str | None) -> Iterator[str]:
    """Be the only process of a role in a run's folder, whatever its id; gives the id.

    Args:
        run_folder: the run's folder.
        role: role of this process.
        wanted: id of this process; None: the name of the role.

    Raises:
        UserError: another process of this role works in the folder.
    """
    with only_one(run_folder, role, role.value):
        yield wanted or role.value


@contextmanager
def owned_training(folder: Path) -> Iterator[None]:
    """Hold the lock of whoever trains in a folder until the context ends.

    It is that of a run's learner, so nobody trains in the folder of a run that is being played.

    Raises:
        UserError: another process trains there.
    """
    with _lock(folder, f"{Role.LEARNER}-{Role.LEARNER}") as held:
        if not held:
            raise UserError(
                f"another process trains in {folder} already: wait until it has ended, or choose "
                "another folder"
            )
        yield


@contextmanager
def own_id(
    run_folder: Path,
    role: Role,
    wanted: str | None,
    *,
    host: str | None = None,
    taken: Collection[str] = (),
) -> Iterator[str]:
    """Reserve an id that no other process of this role in the run's folder has; gives the id.

    Without a wanted id it is the first free one of HOST-1, HOST-2, ...: a restarted process gets
    the id of its predecessor, and finds the files that the predecessor left.

    Args:
        run_folder: the run's folder.
        role: role of this process.
        wanted: id of this process; None for the first free one.
        host: how the free ids begin; None for the name of this machine.
        taken: ids that are not free, because processes on other machines have them.

    Raises:
        UserError: another process has the wanted id.
    """
    if wanted is not None:
        with only_one(run_folder, role, wanted):
            yield wanted
        return
    if host is None:
        host = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname()).strip("-")[:40] or "host"
    for number in itertools.count(1):
        if f"{host}-{number}" in taken:
            continue
        with _lock(run_folder, f"{role}-{host}-{number}") as held:
            if held:
                yield f"{host}-{number}"
                return


@contextmanager
def _lock(run_folder: Path, name: str) -> Iterator[bool]:
    """Try to lock; gives whether this process holds the lock.

    The operating system frees the lock of a process that dies. A file system without locks is
    told, and does not stop anyone.

    Raises:
        UserError: the lock's file cannot be made.
    """
    path = run_folder / "locks" / name
    make_folder(path.parent)
    with storage_errors(path):
        file = path.open("ab")
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        except OSError as error:  # such as ENOSYS, ENOLCK
            LOG.warning(
                "%s cannot be locked (%s): make sure yourself that no other process uses it",
                path,
                error.strerror,
            )
        yield True
