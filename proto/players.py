"""What the actors of a run can play, for those who hand out episodes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from typing import Final

from proto.suites import Player

PATIENCE_S: Final = 10.0
"""So long after the last change among the actors, an actor that crashed may be back."""


class Players:
    """The present actors and what each can play. Used by several threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Start without any actor."""
        self._clock = clock
        self._lock = threading.Lock()
        self._players: dict[str, Player | None] = {}  # None: it has not said yet what it can play
        self._changed_s = clock()

    def presence(self, actor: str, alive: bool) -> None:
        """Note that an actor has joined or vanished."""
        with self._lock:
            if alive and actor not in self._players:
                self._set(actor, None)
            elif not alive and self._players.pop(actor, None) is not None:
                self._changed_s = self._clock()

    def note(self, actor: str, player: Player) -> None:
        """Note what an actor can play, as it says in a request."""
        with self._lock:
            if self._players.get(actor) != player:
                self._set(actor, player)

    def all_among(self, actors: Collection[str]) -> bool:
        """Whether there is an actor, and every present actor is among some."""
        with self._lock:
            return bool(self._players) and all(actor in actors for actor in self._players)

    def lack(self, can_play: Callable[[Player], bool]) -> bool:
        """Whether something cannot be played by any actor, and none is expected that can.

        False if there is no actor at all, if an actor has not said yet what it can play, and for
        PATIENCE_S after the last change.
        """
        with self._lock:
            players = list(self._players.values())
            patient = self._clock() - self._changed_s < PATIENCE_S
        known = [player for player in players if player is not None]
        if patient or not known or len(known) < len(players):
            return False
        return not any(map(can_play, known))

    def _set(self, actor: str, player: Player | None) -> None:
        self._players[actor] = player
        self._changed_s = self._clock()
