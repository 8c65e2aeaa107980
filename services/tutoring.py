"""Recording tutored cases into a folder, to be resumed at any time."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from actors.tasks.registry import make_task
from proto.config import Config, load_config
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.files import parts_in
from proto.messages import TutoringCase
from proto.recording import read_episode
from services.playing import Job, play_all


def parse_cases(text: str, count: int) -> list[int]:
    """Read `all`, or numbers and ranges such as `0,3,7-9`, of cases 0 .. count - 1.

    Raises:
        UserError: it is neither, or there is no such case.
    """
    if text == "all":
        return list(range(count))
    cases: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        try:
            cases.update(range(int(first), int(last if dash else first) + 1))
        except ValueError:
            raise UserError(f"--cases {text}: write all, or numbers such as 0,3,7-9") from None
    if not cases or max(cases) >= count:
        raise UserError(f"--cases {text}: the cases are 0 to {count - 1}")
    return sorted(cases)


def tutoring_jobs(config: Config, cases: Sequence[int], folder: Path) -> list[Job]:
    """The episodes of a folder: every case `config.tutor.repeats` times, the first time clean."""
    situations = make_task(config.task).tutored()
    return [
        Job(
            situation=situations[case],
            seed=TutoringCase(case, repeat).seed,
            kind=Kind.TUTORING,
            noisy=repeat > 0,
            record_to=folder / f"case{case:02d}_repeat{repeat:02d}.mcap",
        )
        for repeat in range(config.tutor.repeats)
        for case in cases
    ]


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
    saved = folder / "config.yaml"
    if not saved.exists():
        config.save(saved)
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
        if (section, name) != ("tutor", "repeats")
    }
