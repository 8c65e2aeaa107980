"""What every process on the bus does: live, tell its metrics, obey, stop cleanly."""

from __future__ import annotations

import fcntl
import itertools
import logging
import re
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Final, Protocol

from proto.bus import Bus
from proto.errors import UserError
from proto.keys import Role
from proto.messages import Command, Control, ControlReply
from proto.metrics import Metrics

LOG = logging.getLogger(__name__)

METRICS_PERIOD_S: Final = 1.0
FROZEN_S: Final = 12.0
"""After so long a process that does not answer any more has lost its presence."""


class Lifecycle:
    """Whether a process should go on, as signals and control messages say."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._paused = threading.Event()

    @property
    def stopping(self) -> bool:
        """Whether it was told to stop."""
        return self._stop.is_set()

    @property
    def paused(self) -> bool:
        """Whether it was told to pause."""
        return self._paused.is_set()

    def stop(self) -> None:
        """Ask it to stop."""
        self._stop.set()

    def pause(self) -> None:
        """Ask it to pause."""
        self._paused.set()

    def resume(self) -> None:
        """End the pause."""
        self._paused.clear()

    def wait(self, seconds: float) -> None:
        """Do nothing for so long, or until it should stop."""
        self._stop.wait(seconds)

    def stop_on_signals(self) -> None:
        """From now on SIGTERM and SIGINT ask it to stop."""

        def on_signal(_number: int, _frame: FrameType | None) -> None:
            self.stop()

        signal.signal(signal.SIGTERM, on_signal)
        signal.signal(signal.SIGINT, on_signal)


class Member(Protocol):
    """A process on the bus, as the others see it."""

    def metrics(self) -> Metrics:
        """What it tells about itself; called about once a second from another thread."""

    def checkpoint(self) -> str:
        """Write to disk what a restart would need, and say what was written."""


@contextmanager
def membership(bus: Bus, member: Member, lifecycle: Lifecycle) -> Iterator[None]:
    """Be present, tell metrics and answer control messages as long as the context lasts."""

    def on_control(control: Control) -> ControlReply:
        return ControlReply(bus.role, bus.id, _obey(control.command, member, lifecycle))

    def tell() -> None:
        bus.publish(bus.keys.metrics(bus.role, bus.id), member.metrics())

    bus.answer(bus.keys.control(bus.role), Control, on_control)
    bus.announce()
    with every(METRICS_PERIOD_S, tell):
        yield
    tell()  # the last word, so that what was reached is known


def _obey(command: Command, member: Member, lifecycle: Lifecycle) -> str:
    match command:
        case Command.PAUSE:
            lifecycle.pause()
            return "paused"
        case Command.RESUME:
            lifecycle.resume()
            return "resumed"
        case Command.CHECKPOINT:
            return member.checkpoint()
        case Command.STOP:
            lifecycle.stop()
            return "stopping"


@contextmanager
def every(period_s: float, action: Callable[[], None]) -> Iterator[None]:
    """Repeat an action in a thread of its own as long as the context lasts."""
    over = threading.Event()

    def repeat() -> None:
        while not over.wait(period_s):
            try:
                action()
            except Exception:
                LOG.exception("what is done every %s s failed", period_s)

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def only_one(run_folder: Path, role: Role, process: str) -> Iterator[None]:
    """Be the only process of this role and id that works in the run's folder.

    Raises:
        UserError: there is one already.
    """
    with _lock(run_folder, role, process) as mine:
        if not mine:
            raise UserError(
                f"{_a(role)} with the id {process!r} already works in {run_folder}: stop it, or "
                "choose another --id or run"
            )
        yield


@contextmanager
def own_id(run_folder: Path, role: Role, wanted: str | None) -> Iterator[str]:
    """The wanted id, or HOST-1, HOST-2, ...: the first that no living process here has.

    A restarted process so finds what its predecessor left.

    Raises:
        UserError: the wanted id is taken.
    """
    if wanted is not None:
        with only_one(run_folder, role, wanted):
            yield wanted
        return
    host = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname()).strip("-")[:40] or "host"
    for number in itertools.count(1):
        with _lock(run_folder, role, f"{host}-{number}") as mine:
            if mine:
                yield f"{host}-{number}"
                return


@contextmanager
def _lock(run_folder: Path, role: Role, process: str) -> Iterator[bool]:
    """Whether this process holds the lock; the system frees it when the process dies."""
    path = run_folder / "locks" / f"{role}-{process}"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True


def alone_in_run(bus: Bus, lifecycle: Lifecycle, *, patience_s: float = FROZEN_S) -> None:
    """Make sure, on all machines, that no other process has this one's role.

    One that has just frozen is given the time to be given up.

    Raises:
        UserError: there is another.
    """
    patience_over_s = time.monotonic() + patience_s
    while (others := bus.present(bus.role)) and not lifecycle.stopping:
        if time.monotonic() > patience_over_s:
            raise UserError(
                f"run {bus.keys.run} has {_a(bus.role)} already ({', '.join(sorted(others))}): "
                "stop it, or choose another run with --set run.name=NAME"
            )
        lifecycle.wait(0.2)


def _a(role: Role) -> str:
    return f"an {role}" if role[0] in "ae" else f"a {role}"
