"""Records tutored cases into a folder; an interrupted recording can be continued."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from actors.tasks.contract import Task
from learner.tutoring.store import TutoringStore
from proto.config import Config, load_config
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.messages import TutoringCase
from proto.recordings.episodes import read_episode
from proto.storage import parts_in
from proto.variables import Situation
from services.playing.workers import Job, play_all


@dataclass(frozen=True)
class Case:
    """A situation to be tutored.

    Attributes:
        name: first part of the names of its files.
        number: index of the tutored case of the task, or seed of the random situation.
        situation: the values of the task's variables by name.
    """

    name: str
    number: int
    situation: Situation

    @classmethod
    def tutored(cls, task: Task, index: int) -> Self:
        """Return one of the task's tutored cases."""
        return cls(f"case{index:02d}", index, task.tutored()[index])

    @classmethod
    def random(cls, task: Task, seed: int) -> Self:
        """Return the situation that the task samples with a seed."""
        return cls(f"random{seed:06d}", seed, task.sample(seed))


def parse_cases(text: str, task: Task, seed: int) -> list[Case]:
    """Parse a choice of cases of a task.

    Args:
        text: `all`, numbers and ranges such as `0,3,7-9`, or `random:40`.
        task: the task.
        seed: random case i is the situation that the task samples with seed + i. A larger number of
            random cases therefore includes those of a smaller number.

    Raises:
        UserError: the text has another form, or there is no such case.
    """
    kind, colon, count = text.partition(":")
    if kind != "random":
        return [Case.tutored(task, index) for index in _indices(text, len(task.tutored()))]
    if not colon or not count.isdecimal() or int(count) < 1:
        raise UserError(f"--cases {text}: give the number of random cases, such as random:40")
    return [Case.random(task, seed + i) for i in range(int(count))]


def _indices(text: str, count: int) -> list[int]:
    if text == "all":
        return list(range(count))
    cases: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        try:
            cases.update(range(int(first), int(last if dash else first) + 1))
        except ValueError:
            raise UserError(
                f"--cases {text}: write all, random:40, or numbers such as 0,3,7-9"
            ) from None
    if not cases or max(cases) >= count:
        raise UserError(f"--cases {text}: the cases are 0 to {count - 1}")
    return sorted(cases)


def tutoring_jobs(config: Config, cases: Sequence[Case], folder: Path) -> list[Job]:
    """Make the jobs of a recording: each case `config.tutor.repeats` times, first without noise."""
    return [
        Job(
            situation=case.situation,
            seed=TutoringCase(config.task.name, case.number, repeat).seed,
            kind=Kind.TUTORING,
            noisy=repeat > 0,
            record_to=folder / f"{case.name}_repeat{repeat:02d}.mcap",
        )
        for repeat in range(config.tutor.repeats)
        for case in cases
    ]


def repeated_jobs(store: TutoringStore, folder: Path) -> list[Job]:
    """Make jobs that repeat the tutoring of a store's sequences, with the same file names.

    Raises:
        UserError: a sequence was not played by the tutor alone, so it cannot be repeated.
    """
    jobs = []
    for name in store.ids:
        episode = store.load(name)
        if episode is None:
            continue
        if episode.kind is not Kind.TUTORING or episode.policy != "tutor":
            raise UserError(
                f"{name} in {store.folder} was played by {episode.policy}, not by the tutor alone;"
                " use sequences that `vmdnn tutor` recorded"
            )
        jobs.append(
            Job(
                situation=episode.situation,
                seed=episode.seed,
                kind=Kind.TUTORING,
                noisy=not np.array_equal(episode.actions, episode.targets),
                record_to=folder / f"{name}.mcap",
            )
        )
    return jobs


def record(
    config: Config, jobs: Sequence[Job], folder: Path, *, workers: int
) -> Generator[Episode, None, None]:
    """Play and record the jobs whose file is missing or damaged; yield the episodes of all jobs.

    Raises:
        UserError: the folder was recorded with another task, simulator or tutor.
    """
    save_or_check_config(folder, config)
    for part in parts_in(folder):
        part.unlink()
    missing = []
    for job in jobs:
        episode = _recorded(job)
        if episode is None:
            missing.append(job)
        else:
            yield episode
    with closing(play_all(config, "tutor", missing, workers=workers)) as played:
        yield from (episode for _, episode in played)


def _recorded(job: Job) -> Episode | None:
    """Read the recorded episode of a job; None if there is none or it is damaged."""
    if job.record_to is None or not job.record_to.exists():
        return None
    try:
        return read_episode(job.record_to)
    except UserError:
        return None  # damaged: the job is played again and replaces the file


def save_or_check_config(folder: Path, config: Config) -> None:
    """Save the configuration in a new folder; check that it fits the one of an existing folder.

    Raises:
        UserError: it does not fit.
    """
    check_recorded(folder, config)
    saved = folder / "config.yaml"
    if not saved.exists():
        config.save(saved)


def check_recorded(folder: Path, config: Config) -> None:
    """Check that a folder's saved configuration has the same task, simulator and tutor.

    Raises:
        UserError: it differs; the message names each value.
    """
    saved = folder / "config.yaml"
    if not saved.exists():
        return
    before, now = _recording_settings(load_config(saved)), _recording_settings(config)
    changed = [name for name in now if before[name] != now[name]]
    if changed:
        values = ", ".join(f"{name} = {before[name]!r}, not {now[name]!r}" for name in changed)
        raise UserError(f"{folder} was recorded with {values}; record to another folder")


def _recording_settings(config: Config) -> dict[str, Any]:
    """Return the settings that determine a tutored episode."""
    sections = config.model_dump(mode="json", include={"task", "simulator", "tutor"})
    return {
        f"{section}.{name}": value
        for section, values in sections.items()
        for name, value in values.items()
        if (section, name) not in {("tutor", "repeats"), ("tutor", "guidance_deg")}
    }
