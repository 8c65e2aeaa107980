"""Recording tutored cases into a folder, to be resumed at any time."""

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
        name: what its files are called, the same whenever it is recorded.
        number: index of a tutored case of the task, or the seed of a random one.
        situation: what it is.
    """

    name: str
    number: int
    situation: Situation

    @classmethod
    def tutored(cls, task: Task, index: int) -> Self:
        """One of the task's tutored cases."""
        return cls(f"case{index:02d}", index, task.tutored()[index])

    @classmethod
    def random(cls, task: Task, seed: int) -> Self:
        """The situation that the task samples with a seed."""
        return cls(f"random{seed:06d}", seed, task.sample(seed))


def parse_cases(text: str, task: Task, seed: int) -> list[Case]:
    """Read which cases of a task are asked for.

    Args:
        text: `all`, numbers and ranges such as `0,3,7-9`, or `random:40`.
        task: the task.
        seed: random case i is what the task samples with seed + i, so that more of them are the
            same ones and others.

    Raises:
        UserError: it is none of these, or there is no such case.
    """
    kind, colon, count = text.partition(":")
    if kind != "random":
        return [Case.tutored(task, index) for index in _indices(text, len(task.tutored()))]
    if not colon or not count.isdecimal() or int(count) < 1:
        raise UserError(f"--cases {text}: write how many, such as random:40")
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
    """The episodes of a folder: every case `config.tutor.repeats` times, the first time clean."""
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


def tutoring_jobs_again(store: TutoringStore, folder: Path) -> list[Job]:
    """Jobs that tutor once more what the sequences of a store show, under the same names.

    Raises:
        UserError: a sequence was not shown by the tutor alone, so it cannot be shown again.
    """
    jobs = []
    for name in store.ids:
        episode = store.load(name)
        if episode is None:
            continue
        if episode.kind is not Kind.TUTORING or episode.policy != "tutor":
            raise UserError(
                f"{name} in {store.folder} was not shown by the tutor alone, but by"
                f" {episode.policy}; take sequences that `vmdnn tutor` recorded"
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
    """Record what of `jobs` the folder lacks, and yield all their episodes.

    Raises:
        UserError: the folder was recorded with another task, simulator or tutor.
    """
    _claim(folder, config)
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
    """The episode of a job that was recorded before and is whole."""
    if job.record_to is None or not job.record_to.exists():
        return None
    try:
        return read_episode(job.record_to)
    except UserError:
        return None  # damaged: it is played again, and replaced once it is whole


def _claim(folder: Path, config: Config) -> None:
    """Save the configuration with the first recording, and keep to it with all others."""
    check_recorded(folder, config)
    saved = folder / "config.yaml"
    if not saved.exists():
        config.save(saved)


def check_recorded(folder: Path, config: Config) -> None:
    """Refuse a folder that says it was recorded with another task, simulator or tutor.

    Raises:
        UserError: it does; the message names each value.
    """
    saved = folder / "config.yaml"
    if not saved.exists():
        return
    before, now = _what_matters(load_config(saved)), _what_matters(config)
    changed = [name for name in now if before[name] != now[name]]
    if changed:
        told = ", ".join(f"{name} = {before[name]!r}, not {now[name]!r}" for name in changed)
        raise UserError(f"{folder} was recorded with {told}; record to another folder")


def _what_matters(config: Config) -> dict[str, Any]:
    """The settings that make a tutored episode what it is."""
    sections = config.model_dump(mode="json", include={"task", "simulator", "tutor"})
    return {
        f"{section}.{name}": value
        for section, values in sections.items()
        for name, value in values.items()
        if (section, name) not in {("tutor", "repeats"), ("tutor", "guidance_deg")}
    }
