"""Which role may send which message, checked with every message that comes over the bus.

Whoever can connect to the hub can write any name into a message. This keeps out mistakes, and
processes of another run or version. It does not keep out a forger: that is what certificates and
`proto.permissions` are for.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

from proto.keys import Role
from proto.messages import (
    EpisodeFailed,
    EpisodeOutcome,
    Live,
    Pictures,
    PolicyVersion,
    Receipt,
    Rollout,
    Sequence,
    Verdict,
)
from proto.metrics import Metrics

_ROLES: Final = frozenset(Role)
_SENDERS_REMEMBERED: Final = 1024
_ID: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True)
class Sender:
    """The process that sent a message, as it says itself: its role and id."""

    role: Role
    id: str

    @classmethod
    @lru_cache(_SENDERS_REMEMBERED)
    def parse(cls, text: str) -> Sender | None:
        """Read `role/id`; None if it is not that."""
        role, _, name = text.partition("/")
        if role not in _ROLES or not is_id(name):
            return None
        return cls(Role(role), name)

    def __str__(self) -> str:
        return f"{self.role}/{self.id}"


MAY_SEND: Final[Mapping[type[Any], frozenset[Role]]] = {
    PolicyVersion: frozenset({Role.LEARNER}),
    Verdict: frozenset({Role.EVALUATOR}),
    Receipt: frozenset({Role.LEARNER, Role.EVALUATOR, Role.RECORDER}),
}
"""Roles that may send a message. Anybody may send the others."""


def is_id(text: str) -> bool:
    """Whether a text is the id of a process."""
    return _ID.fullmatch(text) is not None


def origin_problem(message: object, key: str, sender: Sender | None) -> str:
    """Return why a message cannot come from where it says it comes; empty if it can.

    Args:
        message: the decoded message.
        key: the key under which it was published.
        sender: the process that its attachment names; None if it names none.
    """
    roles = MAY_SEND.get(type(message))
    if roles is not None and (sender is None or sender.role not in roles):
        allowed = " or ".join(sorted(roles))
        return f"only {allowed} may send it, not {sender or 'a sender without a name'}"
    owner = _owner(message)
    if owner and not key.endswith(f"/{owner}"):
        return f"it is of {owner}, but its key is that of another process"
    return ""


def _owner(message: object) -> str:
    """The end of the key under which a process publishes its own messages; empty for others."""
    match message:
        case Sequence(episode) | Rollout(episode):
            return episode.actor
        case EpisodeFailed() | EpisodeOutcome() | Live() | Pictures():
            return message.actor
        case Metrics():
            return f"{message.role}/{message.id}"
        case _:
            return ""
