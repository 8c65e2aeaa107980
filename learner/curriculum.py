"""Which tutored cases are still to be shown, and who is showing which."""

from __future__ import annotations

from collections.abc import Iterable

from proto.config import Config
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.leases import Leases
from proto.messages import TutoringCase


class Curriculum:
    """Hands out each case once; again when it was not shown in time. Used by several threads.

    The clean executions of all cases come first: what is learned from first is most different.

    Attributes:
        size: number of sequences there will be.
    """

    def __init__(self, config: Config, tutored_cases: int) -> None:
        """Plan what the configuration asks for, of a task with so many tutored cases.

        Raises:
            UserError: the configuration names a case that the task does not have.
        """
        cases = range(tutored_cases) if config.learner.cases is None else config.learner.cases
        wrong = [case for case in cases if case >= tutored_cases]
        if wrong:
            raise UserError(
                f"learner.cases: there is no case {wrong[0]}; the task {config.task.name} has "
                f"the tutored cases 0 to {tutored_cases - 1}"
            )
        planned = [
            TutoringCase(case, repeat)
            for repeat in range(config.tutor.repeats)
            for case in dict.fromkeys(cases)
        ]
        self.size = len(planned)
        self._task = config.task.name
        self._missing = {case.seed: case for case in planned}  # in the order of the plan
        self._leases: Leases[TutoringCase] = Leases(config.learner.lease_s)

    @property
    def missing(self) -> int:
        """Number of sequences that are still to come."""
        return len(self._missing)

    def next_case(self, actor: str) -> TutoringCase | None:
        """A case for this actor to show; None if nothing is left."""
        missing = list(self._missing.values())  # a copy: the other thread may shorten it
        return self._leases.take(actor, missing)

    def release(self, actor: str) -> None:
        """The actor is gone: what it was showing is handed out again."""
        self._leases.release(actor)

    def wants(self, episode: Episode) -> bool:
        """Whether an episode shows a case that is still missing."""
        ours = episode.kind is Kind.TUTORING and episode.task == self._task
        return ours and episode.seed in self._missing

    def shown(self, episodes: Iterable[Episode]) -> None:
        """These episodes are kept: their cases need not be shown any more."""
        for episode in episodes:
            if self.wants(episode):
                self._leases.finish(self._missing.pop(episode.seed))
