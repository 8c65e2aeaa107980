"""The trial log: a file with one line of JSON for each counted trial."""

from __future__ import annotations

import json
import logging
from collections import defaultdict
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from proto.codec import (
    Integer,
    MessageError,
    Wire,
    decode,
    encode,
    message,
    record_of,
    schema_of,
)
from proto.episode import (
    NOT_FINISHED,
    SIMULATION_FAILED,
    ConditionsField,
    Episode,
    Id,
    Outcome,
)
from proto.errors import UserError
from proto.messages import Count, EpisodeFailed, EpisodeOutcome, Rollout
from proto.plain_text import plain
from proto.recordings import format1
from proto.storage import append_line, drop_unfinished_line
from proto.suites import UNLEARNED, Conditions, suite_of
from proto.variables import SituationField

LOG = logging.getLogger(__name__)

FORMAT: Final = 3
"""Newest format of lines; lines of format 1 can be read too. Lines of the suite `unlearned` are
written in format 2, as before there were suites; those of other suites in format 3."""
_PLAIN_FORMAT: Final = 2
_SHORTEST_LINE: Final = 100
"""Bytes of the shortest line; shorter ones are not parsed at all."""
_TOLD: Final = 5
"""The log has so many of the damaged lines that are found at the start, and their number."""


@message("counted_trial", 2, form="json")
@dataclass(frozen=True)
class CountedTrial:
    """One line of the log.

    Attributes:
        run_id: id of the training that the policy comes from.
        policy_version: version of the policy.
        seed: seed of the situation; it identifies the trial of a policy version.
        episode: id of the episode.
        actor: id of the process that played it.
        situation: the values of the task's variables by name.
        outcome: how it ended.
        format: format of the line.
        conditions: as in `proto.episode.Episode`.
    """

    run_id: Id
    policy_version: Count
    seed: int
    episode: Id
    actor: Id
    situation: SituationField
    outcome: Outcome
    format: Annotated[int, Integer(_PLAIN_FORMAT, FORMAT)] = _PLAIN_FORMAT
    conditions: ConditionsField = None

    @property
    def suite(self) -> str:
        """Name of the suite that it belongs to."""
        return suite_of(self.conditions)

    @classmethod
    def of(cls, episode: Episode | EpisodeOutcome, run_id: str) -> CountedTrial:
        """Make the line of an episode, played with a policy of the training `run_id`."""
        return cls(
            run_id=run_id,
            policy_version=episode.policy_version,
            seed=episode.seed,
            episode=episode.id,
            actor=episode.actor,
            situation=episode.situation,
            outcome=episode.outcome,
            format=_format_with(episode.conditions),
            conditions=episode.conditions,
        )

    def line(self, *, check: bool = True) -> bytes:
        """Return the line of JSON, with a line break at its end; arguments as in `encode`."""
        return encode(self, check=check).payload + b"\n"


def _format_with(conditions: Conditions | None) -> int:
    return _PLAIN_FORMAT if conditions is None else FORMAT


def read_trials(path: Path) -> list[CountedTrial]:
    """Read all trials of a trial log, or of a file that `vmdnn evaluate --outcomes` wrote.

    Raises:
        UserError: the file cannot be read, or a line is not a counted trial.
    """
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    try:
        return [parse_line(line) for line in lines]
    except MessageError as error:
        raise UserError(
            f"{path} is not a file of counted trials ({error});"
            " `vmdnn evaluate --outcomes FILE` writes one"
        ) from error


def parse_line(line: bytes) -> CountedTrial:
    """Parse a line of format 1, 2 or 3.

    Raises:
        MessageError: the line is not a counted trial, or its format is newer.
    """
    schema = schema_of(CountedTrial)
    encoding = schema.encoding
    if not _SHORTEST_LINE <= len(line) <= schema.limit:
        raise MessageError("payload", f"a line of {len(line)} bytes is no counted trial")
    try:
        values = json.loads(line)
        number = values.setdefault("format", 1)
        if number == 1:
            outcome = format1.outcome_of(values["outcome"])
            values["outcome"] = record_of(Outcome).pack(outcome)
            values["format"] = _PLAIN_FORMAT
            line = json.dumps(values).encode()
    except (
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
        OverflowError,
    ) as error:
        raise MessageError(
            "payload", f"is not a counted trial: {plain(repr(error), 128)}"
        ) from error
    if isinstance(number, int) and number > FORMAT:
        raise MessageError(
            "format",
            f"{plain(number, 100)} was written by a newer vmdnn; this one reads formats up to"
            f" {FORMAT}: update vmdnn to read it",
        )
    return decode(Wire(encoding, line), CountedTrial)


class TrialLog:
    """Counts each trial of each policy version once, also across restarts.

    Attributes:
        damaged: number of lines that could not be read; they stay in the file and are not counted.
    """

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        """Open a trial log, or create it.

        A last line that is incomplete, because a process was killed, is dropped.

        Args:
            path: the file.
            read_only: change nothing on disk, because another process may write to the file.
        """
        self._path = path
        self.damaged = 0
        self._trials: dict[tuple[str, int, str], dict[int, CountedTrial]] = defaultdict(dict)
        if not read_only and drop_unfinished_line(path):
            LOG.warning("%s: dropped its last line, which was not finished", path)
        content = path.read_bytes() if path.exists() else b""
        for number, line in enumerate(content.splitlines(), 1):
            self._read(line, number)
        if self.damaged > _TOLD:
            LOG.warning("%s: %d lines are not counted", path, self.damaged)

    def add(self, rollout: Rollout) -> bool:
        """Write a trial to disk and count it.

        Returns:
            False if the trial was counted before; then nothing changes.

        Raises:
            UserError: the file cannot be written; the trial is not counted.
        """
        return self._add(CountedTrial.of(rollout.episode, rollout.run_id))

    def add_outcomes(self, played: Iterable[EpisodeOutcome]) -> list[EpisodeOutcome]:
        """Write trials that came over the bus to disk, all at once, and count them.

        Returns:
            Those that were not counted before.

        Raises:
            UserError: the file cannot be written; none is counted.
        """
        new: dict[tuple[str, int, str, int], EpisodeOutcome] = {}
        for each in played:
            counted = self._trials.get((each.training, each.policy_version, each.suite), {})
            if each.seed not in counted:
                key = (each.training, each.policy_version, each.suite, each.seed)
                new.setdefault(key, each)
        trials = [CountedTrial.of(each, each.training) for each in new.values()]
        if trials:
            # The fields of a message were checked when it was decoded.
            lines = b"".join(trial.line(check=False) for trial in trials)
            append_line(self._path, lines)
        for trial in trials:
            self._count(trial)
        return list(new.values())

    def add_failure(self, report: EpisodeFailed) -> bool:
        """Count a trial that has no outcome as a failure; otherwise as `add`."""
        return self._add(
            CountedTrial(
                run_id=report.training,
                policy_version=report.policy_version,
                seed=report.seed,
                episode=report.id,
                actor=report.actor,
                situation=report.situation,
                outcome=NOT_FINISHED if report.died else SIMULATION_FAILED,
                format=_format_with(report.conditions),
                conditions=report.conditions,
            )
        )

    def versions(self, run_id: str, suite: str = UNLEARNED) -> list[int]:
        """Return the policy versions of a training with counted trials in a suite, oldest first."""
        keys = list(self._trials)  # a copy, because another thread may add to it
        return sorted(version for run, version, name in keys if (run, name) == (run_id, suite))

    def tried_versions(self, run_id: str) -> list[int]:
        """Return the policy versions of a training with trials in any suite, oldest first."""
        return sorted({version for run, version, _ in list(self._trials) if run == run_id})

    def seeds(self, run_id: str, policy_version: int, suite: str = UNLEARNED) -> Container[int]:
        """Return the seeds of the counted trials of a policy version in a suite."""
        return self._trials.get((run_id, policy_version, suite), {})

    def outcomes(
        self, run_id: str, policy_version: int, suite: str = UNLEARNED
    ) -> Mapping[int, Outcome]:
        """Return the outcomes of a policy version in a suite by the trial's seed."""
        counted = self._trials.get((run_id, policy_version, suite), {})
        return {seed: trial.outcome for seed, trial in list(counted.items())}

    def trials(
        self, run_id: str, policy_version: int, suite: str = UNLEARNED
    ) -> list[CountedTrial]:
        """Return the counted trials of a policy version in a suite, in the order of the file."""
        return list(self._trials.get((run_id, policy_version, suite), {}).values())

    def _add(self, trial: CountedTrial) -> bool:
        if trial.seed in self.seeds(trial.run_id, trial.policy_version, trial.suite):
            return False
        append_line(self._path, trial.line())
        return self._count(trial)

    def _count(self, trial: CountedTrial) -> bool:
        counted = self._trials[trial.run_id, trial.policy_version, trial.suite]
        return counted.setdefault(trial.seed, trial) is trial

    def _read(self, line: bytes, number: int) -> None:
        if len(line) < _SHORTEST_LINE:
            self._skip(number, f"it has only {len(line)} bytes")
            return
        try:
            self._count(parse_line(line))
        except MessageError as error:
            self._skip(number, str(error))

    def _skip(self, number: int, problem: str) -> None:
        self.damaged += 1
        if self.damaged <= _TOLD:
            LOG.warning("%s, line %d is not counted: %s", self._path, number, problem)
