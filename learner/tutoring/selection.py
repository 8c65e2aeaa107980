"""Which sequences of a store a training learns from, and in which order."""

from __future__ import annotations

import logging
from collections.abc import Iterable

import numpy as np

from learner.tutoring.store import TutoringStore
from proto.episode import Episode, Kind
from proto.errors import UserError

LOG = logging.getLogger(__name__)


class Intake:
    """Gives each sequence of a store to the training once, except those it cannot learn from.

    Attributes:
        taken: ids of the sequences given so far, in that order.
        situations: the different situations of these sequences.
        refused: why the other sequences cannot be learned from, by id.
    """

    def __init__(
        self, store: TutoringStore, image: tuple[int, int], values: Iterable[str] = ()
    ) -> None:
        """Take sequences from `store`.

        Args:
            store: the sequences.
            image: (width, height) that the pictures must have.
            values: names of values that the situations must have.
        """
        self._store = store
        self._image = image
        self._values = tuple(values)
        self.taken: list[str] = []
        self.situations: set[frozenset[tuple[str, float]]] = set()
        self.refused: dict[str, str] = {}

    def new(self) -> list[Episode]:
        """Sequences that were added since the last call, ordered by id."""
        known = {*self.taken, *self.refused}
        return self._take(name for name in self._store.ids if name not in known)

    def again(self, sequences: Iterable[str]) -> list[Episode]:
        """The sequences with these ids, in this order, as they were taken before a restart."""
        wanted = tuple(sequences)
        episodes = self._take(wanted)
        if len(episodes) < len(wanted):
            LOG.warning(
                "%d of %d sequences of the checkpoint are gone; training goes on without them,"
                " not exactly as it would have",
                len(wanted) - len(episodes),
                len(wanted),
            )
        return episodes

    def complaint(self) -> str:
        """Why the store has no sequence to learn from, and what to do."""
        problems = {**self._store.damaged, **self.refused}
        folder = self._store.folder
        if not problems:
            return f"{folder} holds no tutored sequence (*.mcap); record some with `vmdnn tutor`"
        listed = "\n".join(f"  {problem}" for problem in list(problems.values())[:3])
        return f"none of the {len(problems)} sequences in {folder} can be learned from:\n{listed}"

    def _take(self, sequences: Iterable[str]) -> list[Episode]:
        episodes = []
        for sequence in sequences:
            episode = self._store.load(sequence)
            if episode is None:
                continue
            try:
                self._check(episode)
            except UserError as error:
                LOG.warning("tutoring sequence refused: %s", error)
                self.refused[sequence] = str(error)
                continue
            episodes.append(episode)
            self.taken.append(sequence)
            self.situations.add(frozenset(episode.situation.items()))
        return episodes

    def _check(self, episode: Episode) -> None:
        width, height = self._image
        if episode.kind not in (Kind.TUTORING, Kind.CORRECTION):
            raise UserError(f"{episode.id} is a {episode.kind} episode, not a tutored one")
        if episode.steps == 0 or episode.images.shape[1:] != (height, width):
            raise UserError(
                f"{episode.id} has pictures {episode.images.shape}, not (steps, {height}, {width})"
                " as network.image says"
            )
        if not np.isfinite(episode.targets).all():
            raise UserError(f"{episode.id} has targets that are not finite numbers")
        for value in self._values:
            if value not in episode.situation:
                raise UserError(
                    f"{episode.id} has no {value!r} in its situation, which"
                    " learner.pretraining.labels asks for; it has"
                    f" {', '.join(sorted(episode.situation))}"
                )
