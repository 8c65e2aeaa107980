"""Which tutored cases are still to be shown, and who is showing which."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from proto.config import Config
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.leases import Leases
from proto.messages import TutoringCase


class Curriculum:
    """Hands out each case once; again when it was not shown in time. Used by several threads.

    The cases of pre-training come first, if they are of another task, then those of the task. Of
    either the clean executions of all cases come first: what is learned from first is most
    different.

    Attributes:
        sizes: number of sequences that there will be, by the name of their task.
    """

    def __init__(self, config: Config, tutored_cases: Mapping[str, int]) -> None:
        """Plan what the configuration asks for.

        Args:
            config: the configuration.
            tutored_cases: number of tutored cases of each task, by name.

        Raises:
            UserError: the configuration names a case that the task does not have.
        """
        planned = []
        if config.pretraining_task is not None:
            task, first = config.pretraining_task, config.learner.pretraining
            option = "learner.pretraining.cases"
            planned += _plan(task, tutored_cases[task], first.cases, first.repeats, option)
        task, cases = config.task.name, config.learner.cases
        planned += _plan(task, tutored_cases[task], cases, config.tutor.repeats, "learner.cases")
        self.sizes = Counter(case.task for case in planned)
        self._missing = {_name(case): case for case in planned}  # in the order of the plan
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
        return episode.kind is Kind.TUTORING and _name(episode) in self._missing

    def shown(self, episodes: Iterable[Episode]) -> None:
        """These episodes are kept: their cases need not be shown any more."""
        for episode in episodes:
            if self.wants(episode):
                self._leases.finish(self._missing.pop(_name(episode)))


def _name(case: TutoringCase | Episode) -> tuple[str, int]:
    """What a case has in common with the episode that shows it."""
    return case.task, case.seed


def _plan(
    task: str, tutored_cases: int, cases: Sequence[int] | None, repeats: int, option: str
) -> list[TutoringCase]:
    """So many repeats of some cases of a task, None for all; `option` is where they come from."""
    wanted = range(tutored_cases) if cases is None else cases
    wrong = [case for case in wanted if case >= tutored_cases]
    if wrong:
        raise UserError(
            f"{option}: there is no case {wrong[0]}; the task {task} has the tutored cases "
            f"0 to {tutored_cases - 1}"
        )
    return [
        TutoringCase(task, case, repeat)
        for repeat in range(repeats)
        for case in dict.fromkeys(wanted)
    ]
