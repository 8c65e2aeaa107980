"""Messages that must arrive: kept on disk, and sent again until all receivers have answered."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from proto.codec import Wire
from proto.errors import UserError
from proto.keys import Role
from proto.storage import change_suffix, make_folder, parts_in, written_whole

LOG = logging.getLogger(__name__)

RESEND_AFTER_S: Final = 5.0
"""Time to wait for the answer to a message; it doubles each time that none comes."""
RESEND_AFTER_AT_MOST_S: Final = 30.0
IN_FLIGHT: Final = 8
"""Messages that wait for an answer at the same time; each waits for RESEND_AFTER_S at most."""

_LONGEST_HEADER: Final = 4096

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

    A file is one line of JSON with key, encoding and receivers, followed by the payload. Used by
    several threads.
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
        self._folder = folder
        self._send = send
        self._resend_after_s = resend_after_s
        self._at_most_s = max(RESEND_AFTER_AT_MOST_S, resend_after_s)
        self._clock = clock
        self._lock = threading.Lock()
        self._last_answer_s = clock()
        self._entries = {
            path.stem.partition("-")[2]: _Entry(path, _receivers_of(path))
            for path in sorted(folder.glob("*.message"))
        }
        self._put_aside = sum(path.suffix in PUT_ASIDE for path in folder.iterdir())

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def put_aside(self) -> int:
        """Number of messages that are kept but not sent any more: refused or damaged ones."""
        return self._put_aside

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
        path = self._folder / f"{time.time_ns()}-{name}.message"
        values = {"key": key, "encoding": wire.encoding, "receivers": sorted(receivers)}
        header = json.dumps(values).encode()
        with written_whole(path) as stream:
            stream.write(header + b"\n" + wire.payload)
        with self._lock:
            self._entries[name] = _Entry(path, set(receivers))
        self.send_due()

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
            header, _, payload = entry.path.read_bytes().partition(b"\n")
            values = json.loads(header)
            if entry.sends == 1:  # it may be a former process's
                entry.missing = {Role(role) for role in values.get("receivers", ())}
            self._send(values["key"], Wire(values["encoding"], payload))
        except FileNotFoundError:
            pass  # its answer came in between
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            with self._lock:
                self._entries.pop(name, None)
            self._set_aside(entry.path, ".damaged", f"is damaged ({error})")

    def _set_aside(self, path: Path, suffix: str, problem: str) -> None:
        try:
            aside = change_suffix(path, suffix)
        except UserError as error:
            LOG.warning("%s %s, but cannot be put aside: %s", path, problem, error)
            return
        with self._lock:
            self._put_aside += 1
        LOG.warning("a message %s; it is kept in %s and not sent again", problem, aside)


def _receivers_of(path: Path) -> set[Role]:
    """The receivers that a file names; none if it is damaged, which is found when it is sent."""
    try:
        with path.open("rb") as stream:
            header = stream.readline(_LONGEST_HEADER)
        return {Role(role) for role in json.loads(header)["receivers"]}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return set()
