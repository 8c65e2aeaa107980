"""The folder of a run as it is on disk: configuration, policies and counted trials."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from learner.checkpoint import policy_file, training_file
from proto.config import Config, load_config
from proto.errors import UserError
from proto.suites import Suite
from services.trials.success import Tally
from services.trials.trial_log import CountedTrial, TrialLog
from services.trials.trial_playing import LoggedPolicy


@dataclass(frozen=True)
class RunFolder:
    """A run that was started once; its processes may be at work.

    Attributes:
        folder: its folder.
        config: its configuration.
        training: id of its training.
        log: its counted trials, at the moment at which the folder was opened.
    """

    folder: Path
    config: Config
    training: str
    log: TrialLog

    @classmethod
    def open(cls, folder: Path, overrides: Sequence[str] = ()) -> Self:
        """Read what is in a run's folder.

        Args:
            folder: the folder.
            overrides: `key.path=value` overrides of its configuration.

        Raises:
            UserError: it is not the folder of a run.
        """
        file = folder / "config.yaml"
        if not file.is_file():
            raise UserError(
                f"{folder} is not the folder of a run, because it holds no config.yaml;"
                " `vmdnn runs` lists the runs"
            )
        config = load_config(file, overrides)
        id_file = training_file(folder).with_name("run_id")
        # `vmdnn train` gives a training no id.
        training = id_file.read_text().strip() if id_file.is_file() else config.run.name
        return cls(folder, config, training, TrialLog(trial_log_file(folder), read_only=True))

    @property
    def versions(self) -> list[int]:
        """Versions of the policies that are in the folder, oldest first."""
        files = policy_file(self.folder, 0).parent.glob("*.safetensors")
        return sorted(int(file.stem) for file in files if re.fullmatch("[0-9]{6}", file.stem))

    def policy(self, version: int) -> LoggedPolicy:
        """A policy as the trial log names it."""
        return LoggedPolicy(policy_file(self.folder, version), self.training, version)

    def tally(self, version: int, suite: Suite) -> Tally:
        """The counted trials of a policy version in a suite."""
        outcomes = self.log.outcomes(self.training, version, suite.name)
        return Tally.of(outcome for seed, outcome in outcomes.items() if seed in suite.test_seeds)

    def trials(self, version: int, suite: Suite) -> list[CountedTrial]:
        """The counted trials of a policy version in a suite, in the order of the file."""
        return [
            trial
            for trial in self.log.trials(self.training, version, suite.name)
            if trial.seed in suite.test_seeds
        ]

    @property
    def changed_s(self) -> float:
        """When a policy or a counted trial was written last (Unix time); 0.0 for never."""
        newest = self.versions[-1:]
        files = [trial_log_file(self.folder), *(policy_file(self.folder, n) for n in newest)]
        return max((file.stat().st_mtime for file in files if file.is_file()), default=0.0)

    def best_version(self, suite: Suite) -> int | None:
        """The version with the most reliable success in a suite; None if no trial was counted.

        It has the highest lower end of the 95 % interval of precise success; among equal ones that
        of strict and then of lenient success, and then the highest version.
        """

        def quality(version: int) -> tuple[float, ...]:
            tally = self.tally(version, suite)
            readings = ("precise", "strict", "lenient")
            return (*(tally.rate(reading).wilson95[0] for reading in readings), version)

        tried = [each for each in self.versions if self.tally(each, suite).trials]
        return max(tried, key=quality, default=None)

    def chosen_versions(self, words: str, suite: Suite) -> list[int]:
        """Versions that a user names.

        Args:
            words: `all`, `best` (in the suite), `newest` or a number.
            suite: the suite.

        Raises:
            UserError: there is no such version.
        """
        versions = self.versions
        if not versions:
            raise UserError(f"{self.folder} holds no policy yet (policies/*.safetensors)")
        if words == "all":
            return versions
        if words == "newest":
            return versions[-1:]
        if words == "best":
            best = self.best_version(suite)
            if best is None:
                raise UserError(
                    f"no trial of suite {suite.name} was counted in {self.folder} yet, so the best"
                    " version is not known; name another version, such as newest"
                )
            return [best]
        if not words.isdecimal() or int(words) not in versions:
            raise UserError(
                f"--policy-version {words}: {self.folder} has the versions {versions[0]} to"
                f" {versions[-1]}; give one of them, or all, best or newest"
            )
        return [int(words)]


def trial_log_file(folder: Path) -> Path:
    """Where a run keeps its counted trials."""
    return folder / "evaluation" / "trials.jsonl"
