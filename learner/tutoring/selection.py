"""Which sequences of a store a training learns from, and in which order."""

from __future__ import annotations

import logging
from collections.abc import Iterable

import numpy as np

from learner.tutoring.store import TutoringStore
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.variables import Value

LOG = logging.getLogger(__name__)


class Intake:
    """Gives each sequence of a store to the training once, except those it cannot learn from.

    Attributes:
        taken: ids of the sequences given so far, in that order.
        situations: the different situations of these sequences.
        refused: why the other sequences cannot be learned from, by id.
    """

    def __init__(self, store: TutoringStore, task: str, variables: Iterable[str] = ()) -> None:
        """Take sequences from `store`.

        Args:
            store: the sequences.
            task: name of the task that they must show.
            variables: names of the variables that pre-training asks about.
        """
        self._store = store
        self._task = task
        self._variables = tuple(variables)
        self.taken: list[str] = []
        self.situations: set[frozenset[tuple[str, Value]]] = set()
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
        if episode.task != self._task:
            raise UserError(
                f"{episode.id} shows the task {episode.task!r}, not {self._task!r}; take sequences"
                " of that task, or set task.name (for pre-training: learner.pretraining.task)"
            )
        if episode.kind not in (Kind.TUTORING, Kind.CORRECTION):
            raise UserError(f"{episode.id} is a {episode.kind} episode, not a tutored one")
        if episode.steps == 0:
            raise UserError(f"{episode.id} has no steps")
        if not np.isfinite(episode.targets).all():
            raise UserError(f"{episode.id} has targets that are not finite numbers")
        for variable in self._variables:
            if variable not in episode.situation:
                raise UserError(
                    f"{episode.id} has no {variable!r} in its situation, which pre-training asks"
                    f" for; {_what_is_known(episode)}"
                )


def _what_is_known(episode: Episode) -> str:
    if episode.situation:
        return f"it has {', '.join(sorted(episode.situation))}"
    return (
        "its situation is not known. Set learner.pretraining.epochs=0, or pre-train on other"
        " sequences (--pretraining-data)"
    )
