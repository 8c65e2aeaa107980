"""What must arrive: kept on disk until its receipt comes, and sent again until then."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from proto.codec import Wire

LOG = logging.getLogger(__name__)

RESEND_AFTER_S: Final = 5.0
IN_FLIGHT: Final = 8
"""So many of the oldest are sent without a receipt; the others wait their turn."""

Send = Callable[[str, Wire], None]


@dataclass
class _Entry:
    path: Path
    sent_at_s: float = field(default=float("-inf"))


class Outbox:
    """Messages on their way, one file each; those of a former process are found again.

    A file is one line of JSON with key and encoding, and the payload after it.
    """

    def __init__(self, folder: Path, send: Send, *, resend_after_s: float = RESEND_AFTER_S) -> None:
        self._folder = folder
        self._send = send
        self._resend_after_s = resend_after_s
        self._lock = threading.Lock()
        folder.mkdir(parents=True, exist_ok=True)
        self._entries = {
            path.stem.partition("-")[2]: _Entry(path) for path in sorted(folder.glob("*.message"))
        }

    def __len__(self) -> int:
        return len(self._entries)

    def add(self, name: str, key: str, wire: Wire) -> None:
        """Keep a message and send it; `name` is what its receipt will say."""
        path = self._folder / f"{time.time_ns()}-{name}.message"
        unfinished = path.with_suffix(".unfinished")
        header = json.dumps({"key": key, "encoding": wire.encoding}).encode()
        unfinished.write_bytes(header + b"\n" + wire.payload)
        unfinished.rename(path)
        with self._lock:
            self._entries[name] = _Entry(path)
        self.send_due()

    def received(self, name: str) -> None:
        """The receipt of `name` has come; one that is not known is no matter."""
        with self._lock:
            entry = self._entries.pop(name, None)
        if entry is not None:
            entry.path.unlink(missing_ok=True)

    def send_due(self) -> None:
        """Send what was not sent yet, or so long ago that its receipt should have come."""
        now = time.monotonic()
        with self._lock:
            due = [
                (name, entry)
                for name, entry in list(self._entries.items())[:IN_FLIGHT]
                if now - entry.sent_at_s >= self._resend_after_s
            ]
            for _, entry in due:
                entry.sent_at_s = now
        for name, entry in due:
            self._send_one(name, entry)

    def _send_one(self, name: str, entry: _Entry) -> None:
        try:
            header, _, payload = entry.path.read_bytes().partition(b"\n")
            values = json.loads(header)
            self._send(values["key"], Wire(values["encoding"], payload))
        except FileNotFoundError:
            pass  # its receipt came in between
        except (ValueError, KeyError, TypeError) as error:
            LOG.warning("%s is damaged (%s): put aside", entry.path, error)
            entry.path.rename(entry.path.with_suffix(".damaged"))
            with self._lock:
                self._entries.pop(name, None)
