"""What the configurations of a run's processes must agree on; they are compared on joining.

Learner and evaluator answer the settings of a process that joins with their own. A process whose
settings differ from those of a process that is there does not join: its message names the keys.

Each request for work and each episode carries the digest of the sender's settings. So learner and
evaluator hand out nothing to a process with other settings, and neither store nor count what it
plays.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any, Final

from proto.bus import Bus
from proto.config import Config
from proto.errors import UserError
from proto.keys import Role
from proto.messages import Setting, Settings
from proto.plain_text import plain

MUST_AGREE: Final = ("task", "simulator", "network", "tutor")
"""Sections whose values must be the same in all processes of a run, except those below.

All else may differ, such as the hub, folders, and what learner, evaluator and recorder alone use.
"""
MAY_DIFFER: Final = frozenset({"simulator.backend"})
"""Keys of these sections that may differ. Actors of one run may use different simulators: each
episode names its own."""
ANSWERING: Final = (Role.LEARNER, Role.EVALUATOR)
"""Roles whose processes answer with their settings."""
OTHER_SETTINGS: Final = "its configuration is not that of this run"
"""Why nothing is taken from a process whose settings differ."""

_LONGEST_VALUE: Final = 200


def settings_of(config: Config) -> dict[str, str]:
    """Return what must agree: the value of each key, such as `network.pfc.tau`, as JSON.

    A long value, such as a list among a task's options, is replaced by its digest.
    """
    values: dict[str, str] = {}
    for section in MUST_AGREE:
        _flatten(section, getattr(config, section).model_dump(mode="json"), values)
    # Actors play the sequences of pre-training too.
    values["learner.pretraining.task"] = json.dumps(config.pretraining_task)
    return {key: value for key, value in values.items() if key not in MAY_DIFFER}


def digest_of(settings: Mapping[str, str]) -> str:
    """Hash settings; twelve hexadecimal digits."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


def differences(ours: Mapping[str, str], theirs: Mapping[str, str]) -> list[str]:
    """Return the keys whose values differ, each with both values."""
    return [
        f"{key} is {ours.get(key, 'not set')} here and {theirs.get(key, 'not set')} there"
        for key in sorted(ours.keys() | theirs.keys())
        if ours.get(key) != theirs.get(key)
    ]


class Agreement:
    """The settings of this process, compared with those of the run's other processes.

    Attributes:
        digest: digest of the settings; requests and episodes carry it.
    """

    def __init__(self, config: Config, bus: Bus) -> None:
        self._settings = settings_of(config)
        self._bus = bus
        self.digest = digest_of(self._settings)

    def answer(self) -> None:
        """Answer each process that joins with the settings of this one, until the bus is closed."""
        ours = self._message()
        self._bus.answer(self._bus.keys.settings, Settings, lambda _: ours)

    def check(self) -> None:
        """Compare with the processes that answer.

        Raises:
            UserError: the settings differ; the message names each key with both values.
        """
        if problem := self.problem():
            raise UserError(problem)

    def problem(self) -> str:
        """Return how the settings differ from those of a process that answers; empty if nowhere."""
        for theirs in self._bus.ask(self._bus.keys.settings, self._message(), Settings):
            if theirs.role not in ANSWERING or theirs.id == self._bus.id:
                continue
            keys = differences(self._settings, {each.key: each.value for each in theirs.values})
            if keys:
                return (
                    f"this {self._bus.role} does not fit the run {self._bus.keys.run}: its"
                    f" configuration differs from that of the {theirs.role} {theirs.id}.\n"
                    + "\n".join(f"  {plain(line, 500)}" for line in keys[:20])
                    + "\nUse the configuration of the run, config.yaml in its folder, or start a"
                    " run of another name with --set run.name=NAME"
                )
        return ""

    def _message(self) -> Settings:
        values = tuple(Setting(key, value) for key, value in sorted(self._settings.items()))
        return Settings(self._bus.role, self._bus.id, values)


def _flatten(name: str, value: Any, into: dict[str, str]) -> None:
    """Put the values of a section and of its sections into one map by their full keys."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            _flatten(f"{name}.{key}", inner, into)
        return
    text = json.dumps(value, sort_keys=True)
    if len(text) > _LONGEST_VALUE:
        text = f"long, with the digest {hashlib.sha256(text.encode()).hexdigest()[:12]}"
    into[plain(name, _LONGEST_VALUE)] = text
