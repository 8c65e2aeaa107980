"""The task's options, and the clips that are tutored, practised and shown in trials by them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from proto.errors import UserError
from sim_assets.gestures.clip import GestureLibrary
from sim_assets.gestures.drawing import DrawnGestures
from sim_assets.gestures.videos import GestureVideoError, RecordedGestures

OPTIONS: Final = frozenset({"subjects", "takes", "poses", "trials_show", "gestures", "delay_steps"})
DRAWN_OPTIONS: Final = ("subjects", "takes", "trials_show")
"""Options that a folder of videos decides."""
NEW_TAKES: Final = "new-takes"
NEW_SUBJECTS: Final = "new-subjects"
NEW_SUBJECT_COUNT: Final = 50
"""Number of subjects that only trials show."""
NEW_TAKE_COUNT: Final = 100
"""Number of takes of each subject, for either side, that only trials show; as many for practice."""


@dataclass(frozen=True)
class Pool:
    """Clips: all takes of all subjects, for either side.

    Attributes:
        subjects: names of the subjects.
        takes: names of the recordings of each of them, for either side.
    """

    subjects: tuple[str, ...]
    takes: tuple[str, ...]


@dataclass(frozen=True)
class Clips:
    """The clips of a task, by the names of their subjects and takes.

    Attributes:
        library: where they come from.
        tutored: what tutored situations show.
        practice: what practice and corrections show. A policy may be corrected on these.
        trials: what trials show; neither tutored nor practised, unless they are videos.
    """

    library: GestureLibrary
    tutored: Pool
    practice: Pool
    trials: Pool

    @property
    def subjects(self) -> tuple[str, ...]:
        """All subjects, each once."""
        return tuple(dict.fromkeys(name for pool in self._pools for name in pool.subjects))

    @property
    def takes(self) -> tuple[str, ...]:
        """All takes, each once."""
        return tuple(dict.fromkeys(name for pool in self._pools for name in pool.takes))

    @property
    def _pools(self) -> tuple[Pool, ...]:
        return (self.tutored, self.trials, self.practice)


def clips_of(options: Mapping[str, Any], task: str) -> Clips:
    """The clips that the task's options ask for.

    Args:
        options: of OPTIONS, those that are set. `subjects` (1) and `takes` (10) are how many are
            tutored, `trials_show` ("new-takes" or "new-subjects") is what trials show instead, and
            `gestures` is a folder of videos, which is tutored and tested as a whole.
        task: the task's name, for messages.

    Raises:
        UserError: an option has a value that it cannot have, or the videos cannot be used.
    """
    if "gestures" not in options:
        return _drawn(options, task)
    if given := [name for name in DRAWN_OPTIONS if name in options]:
        raise UserError(
            f"task.{given[0]}: the videos of task.gestures give the {task}'s subjects and takes;"
            f" leave out task.{given[0]}"
        )
    return _recorded(options["gestures"])


def whole_number(
    options: Mapping[str, Any], name: str, default: int, *, least: int = 1, most: int | None = None
) -> int:
    """Return the value of an option that is a whole number.

    Args:
        options: the options that are set.
        name: name of the option.
        default: its value if it is not set.
        least: smallest value that is allowed.
        most: largest value that is allowed; None for no limit.

    Raises:
        UserError: the value is not a whole number, or not in the allowed range.
    """
    value = options.get(name, default)
    valid = isinstance(value, int) and not isinstance(value, bool)
    if not valid or value < least or (most is not None and value > most):
        limits = f"of at least {least}" if most is None else f"from {least} to {most}"
        raise UserError(f"task.{name} = {value!r} is not a whole number {limits}")
    return int(value)


def _drawn(options: Mapping[str, Any], task: str) -> Clips:
    subjects, takes = whole_number(options, "subjects", 1), whole_number(options, "takes", 10)
    shown = options.get("trials_show", NEW_TAKES)
    if shown not in {NEW_TAKES, NEW_SUBJECTS}:
        raise UserError(
            f"task.trials_show = {shown!r}: trials of {task} show {NEW_TAKES} or {NEW_SUBJECTS}"
        )
    library = DrawnGestures(subjects, takes)
    tutored = Pool(library.subjects, library.takes)
    if shown == NEW_TAKES:
        trials = Pool(tutored.subjects, _names(takes, NEW_TAKE_COUNT))
        practised_from = takes + NEW_TAKE_COUNT
    else:
        trials = Pool(_names(subjects, NEW_SUBJECT_COUNT), tutored.takes)
        practised_from = takes
    practice = Pool(tutored.subjects, _names(practised_from, NEW_TAKE_COUNT))
    return Clips(library, tutored, practice, trials)


def _recorded(folder: object) -> Clips:
    if not isinstance(folder, str | Path) or not str(folder):
        raise UserError(f"task.gestures = {folder!r} is no name of a folder")
    try:
        library = RecordedGestures(Path(folder).expanduser())
    except GestureVideoError as error:
        raise UserError(f"task.gestures: {error}") from error
    everything = Pool(library.subjects, library.takes)
    return Clips(library, everything, everything, everything)


def _names(first: int, count: int) -> tuple[str, ...]:
    return tuple(str(number) for number in range(first, first + count))
