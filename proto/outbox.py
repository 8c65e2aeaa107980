"""Messages that must arrive: kept on disk, and sent again until all receivers have answered."""

from __future__ import annotations

import hashlib
import json
import logging
import re
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from proto.codec import Wire
from proto.errors import UserError
from proto.keys import Role
from proto.plain_text import plain
from proto.reading import read_limited
from proto.storage import (
    StorageError,
    change_suffix,
    delete_file,
    make_folder,
    parts_in,
    written_whole,
)

LOG = logging.getLogger(__name__)

RESEND_AFTER_S: Final = 5.0
"""Time to wait for the answer to a message; it doubles each time that none comes."""
RESEND_AFTER_AT_MOST_S: Final = 30.0
IN_FLIGHT: Final = 8
"""Messages that wait for an answer at the same time; each waits for RESEND_AFTER_S at most."""

PREPARED: Final = ".prepared"
"""File suffix of messages that are sent if this process dies."""
_LARGEST_FILE: Final = 34 * 2**20
"""Size of a file; an episode, the largest message here, has at most 32 MiB."""
_LARGEST_HEADER: Final = 4096
_DAMAGE: Final = (UserError, ValueError, KeyError, TypeError, AttributeError, RecursionError)
"""What reading a damaged file raises."""

PUT_ASIDE: Final = (".refused", ".damaged")
"""File suffixes of messages that are kept but not sent any more."""

Send = Callable[[str, Wire], None]


@dataclass
class _Entry:
    """A message without an answer.

    Attributes:
        path: its file.
        sends: how often it was sent.
        sent_at_s: when it was sent last (monotonic clock).
        missing: roles whose receipts have not come; empty if the file names none: then any receipt
            is the last one.
    """

    path: Path
    missing: set[Role] = field(default_factory=set)
    sends: int = 0
    sent_at_s: float = float("-inf")


class Outbox:
    """Messages without an answer, one file each; those of a former process are found again.

    A receiver answers with a receipt, or with a refusal, which is final: a refused message is kept
    in a file with the suffix `.refused` and not sent again. A message without an answer is sent
    again, later each time; the first answer after a long silence makes all messages due at once.
    Messages that were sent least often go first, the oldest of them first: messages that nobody
    answers, such as those of another version, do not hold up the others.

    A file is one line of JSON with key, encoding, receivers and the digest of the payload, followed
    by the payload. A damaged file is kept with the suffix `.damaged` and not sent. Used by several
    threads.

    A message can also be prepared for the case that this process dies: the next process that
    opens the folder sends it.
    """

    def __init__(
        self,
        folder: Path,
        send: Send,
        *,
        resend_after_s: float = RESEND_AFTER_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Find the messages in a folder.

        Args:
            folder: where the messages are kept; it is made if it is missing. No other process may
                use it.
            send: sends a message under a key.
            resend_after_s: time to wait for the first answer.
            clock: gives the time in seconds.

        Raises:
            UserError: the folder cannot be made.
        """
        make_folder(folder)
        for unfinished in parts_in(folder):
            unfinished.unlink()
        # The process that would have deleted these died.
        died = [change_suffix(path, ".message") for path in sorted(folder.glob(f"*{PREPARED}"))]
        self._folder = folder
        self._send = send
        self._resend_after_s = resend_after_s
        self._at_most_s = max(RESEND_AFTER_AT_MOST_S, resend_after_s)
        self._clock = clock
        self._lock = threading.Lock()
        self._last_answer_s = clock()
        messages = dict.fromkeys((*died, *sorted(folder.glob("*.message"))))
        self._entries = {message_name(path): _Entry(path, _receivers_of(path)) for path in messages}
        self._of_dead = frozenset(map(message_name, died))
        self._put_aside = sum(path.suffix in PUT_ASIDE for path in folder.iterdir())

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def put_aside(self) -> int:
        """Number of messages that are kept but not sent any more: refused or damaged ones."""
        return self._put_aside

    @property
    def of_dead(self) -> int:
        """Number of messages without an answer that were prepared by a process that died."""
        with self._lock:
            return len(self._of_dead & self._entries.keys())

    @property
    def missing(self) -> set[Role]:
        """Roles whose receipts are missing."""
        with self._lock:
            return {role for entry in self._entries.values() for role in entry.missing}

    def add(self, name: str, key: str, wire: Wire, receivers: Collection[Role] = ()) -> None:
        """Keep a message and send it.

        Args:
            name: the name by which the receiver's answer refers to the message.
            key: where it is sent.
            wire: the message.
            receivers: roles from which a receipt must come; empty: one receipt is enough.

        Raises:
            StorageError: it cannot be written; then it is not sent.
        """
        path = self._write(name, ".message", key, wire, receivers)
        with self._lock:
            self._entries[name] = _Entry(path, set(receivers))
        self.send_due()

    @contextmanager
    def sent_if_killed(
        self, name: str, key: str, wire: Wire, receivers: Collection[Role] = ()
    ) -> Iterator[None]:
        """Have the next process send a message if this one dies before the context ends.

        If the message cannot be written, nothing is prepared. Arguments are those of `add`.
        """
        path: Path | None = None
        with suppress(StorageError):
            path = self._write(name, PREPARED, key, wire, receivers)
        try:
            yield
        finally:
            if path is not None:
                with suppress(StorageError):
                    delete_file(path)

    def received(self, name: str, receiver: Role | None = None) -> None:
        """Delete a message of which all receipts have come. Unknown names are ignored.

        Args:
            name: the name of the message.
            receiver: role of the process whose receipt has come.
        """
        with self._lock:
            waiting = self._entries.get(name)
            if waiting is not None and waiting.missing and receiver is not None:
                waiting.missing.discard(receiver)
                if waiting.missing:
                    return
        entry = self._answered(name)
        if entry is not None:
            entry.path.unlink(missing_ok=True)

    def refused(self, name: str, reason: str) -> None:
        """Put a message aside that the receiver will never take. Unknown names are ignored."""
        entry = self._answered(name)
        if entry is not None:
            self._set_aside(entry.path, ".refused", f"was refused: {reason}")

    def send_due(self) -> None:
        """Send what was not sent yet, and again what should have been answered by now."""
        for name, entry in self._take_due():
            self._send_one(name, entry)

    def _write(
        self, name: str, suffix: str, key: str, wire: Wire, receivers: Collection[Role]
    ) -> Path:
        path = self._folder / f"{time.time_ns()}-{name}{suffix}"
        values = {
            "key": key,
            "encoding": wire.encoding,
            "receivers": sorted(receivers),
            "sha256": hashlib.sha256(wire.payload).hexdigest(),
        }
        with written_whole(path) as stream:
            stream.write(json.dumps(values).encode() + b"\n" + wire.payload)
        return path

    def _take_due(self) -> list[tuple[str, _Entry]]:
        """Choose the messages to send now and note that they are sent."""
        now_s = self._clock()
        with self._lock:
            waiting = [(now_s - entry.sent_at_s, entry) for entry in self._entries.values()]
            in_flight = sum(waited_s < self._resend_after_s for waited_s, _ in waiting)
            due = [
                (name, entry)
                for name, entry in self._entries.items()
                if now_s - entry.sent_at_s >= self._patience_s(entry)
            ]
            due.sort(key=lambda item: item[1].sends)  # a stable sort: the oldest stay first
            chosen = due[: max(0, IN_FLIGHT - in_flight)]
            for _, entry in chosen:
                entry.sent_at_s = now_s
                entry.sends += 1
        return chosen

    def _patience_s(self, entry: _Entry) -> float:
        """How long to wait for an answer after the last time that a message was sent."""
        return min(self._resend_after_s * 2.0 ** max(entry.sends - 1, 0), self._at_most_s)

    def _answered(self, name: str) -> _Entry | None:
        """Take a message out whose answer has come."""
        with self._lock:
            now_s = self._clock()
            if now_s - self._last_answer_s >= self._at_most_s:  # the receiver was away
                for entry in self._entries.values():
                    entry.sent_at_s = float("-inf")
            self._last_answer_s = now_s
            return self._entries.pop(name, None)

    def _send_one(self, name: str, entry: _Entry) -> None:
        try:
            key, receivers, wire = _read_message(entry.path)
            if entry.sends == 1:  # it may be a former process's
                entry.missing = receivers
            self._send(key, wire)
        except FileNotFoundError:
            pass  # its answer came in between
        except _DAMAGE as error:
            with self._lock:
                self._entries.pop(name, None)
            self._set_aside(entry.path, ".damaged", f"is damaged ({_what_is_wrong(error)})")

    def _set_aside(self, path: Path, suffix: str, problem: str) -> None:
        try:
            aside = change_suffix(path, suffix)
        except UserError as error:
            LOG.warning("%s %s, but cannot be put aside: %s", path, problem, error)
            return
        with self._lock:
            self._put_aside += 1
        LOG.warning("a message %s; it is kept in %s and not sent again", problem, aside)


def message_name(path: Path) -> str:
    """The name under which `Outbox.add` got the message of a file."""
    return path.stem.partition("-")[2]


def messages_of_run(run_folder: Path) -> set[Path]:
    """The files of all messages that wait for receipts in the outboxes of a run's folder."""
    return set((run_folder / "outbox").glob("*/*/*.message"))


def message_problem(path: Path) -> str:
    """Return why a file of an outbox is damaged; empty if it is not, or is gone."""
    try:
        _read_message(path)
    except FileNotFoundError:
        return ""
    except _DAMAGE as error:
        return f"it is damaged ({_what_is_wrong(error)})"
    return ""


def _what_is_wrong(error: Exception) -> str:
    return plain(error, 300) or type(error).__name__


def _read_message(path: Path) -> tuple[str, set[Role], Wire]:
    """Key, receivers and message of a file.

    Raises:
        FileNotFoundError: there is no such file.
        one of _DAMAGE: it is damaged.
    """
    header, _, payload = read_limited(path, _LARGEST_FILE).partition(b"\n")
    if len(header) > _LARGEST_HEADER:
        raise ValueError("its first line is too long")
    values = json.loads(header)
    key, encoding, receivers = values["key"], values["encoding"], values.get("receivers", [])
    if not (isinstance(key, str) and isinstance(encoding, str) and isinstance(receivers, list)):
        raise ValueError("its first line does not say where it goes")
    if re.fullmatch(r"[\w.-]+(?:/[\w.-]+)*", key) is None:
        raise ValueError(f"{key!r} is not a key")
    digest = hashlib.sha256(payload).hexdigest()
    if values.get("sha256", digest) != digest:  # older files have no digest
        raise ValueError("its content differs from its digest")
    return key, {Role(role) for role in receivers}, Wire(encoding, payload)


def _receivers_of(path: Path) -> set[Role]:
    """The receivers that a file names; none if it is damaged, which is found when it is sent."""
    try:
        with path.open("rb") as stream:
            header = stream.readline(_LARGEST_HEADER)
        return {Role(role) for role in json.loads(header)["receivers"]}
    except (OSError, *_DAMAGE):
        return set()
