"""Joining a run from any machine: its configuration comes from the bus, and no id is used twice."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from typing import Final

from proto.bus import Bus
from proto.config import Config, read_config
from proto.errors import UserError
from proto.lifecycle import Lifecycle
from proto.messages import ConfigurationRequest, Identity, RunConfiguration

ASK_AGAIN_S: Final = 1.0
SETTLE_S: Final = 1.0
"""Time in which everybody who joins at the same time has heard of the others."""


def answer_configuration(bus: Bus, config: Config) -> None:
    """Answer each process that joins with the configuration of the run, as its learner."""
    ours = RunConfiguration(config.as_json(), config.digest())
    bus.answer(bus.keys.configuration, ConfigurationRequest, lambda _: ours)


def ask_configuration(bus: Bus, overrides: Sequence[str], lifecycle: Lifecycle) -> Config | None:
    """Get the configuration of the run from its learner; wait as long as there is none.

    Args:
        bus: connection to the run.
        overrides: `key.path=value` overrides of this machine.
        lifecycle: says when to stop.

    Returns:
        The configuration with the overrides; None if the process was asked to stop before.

    Raises:
        UserError: it cannot be used here, or it names code that the overrides do not name.
    """
    request = ConfigurationRequest(bus.role)
    while not lifecycle.stopping:
        lifecycle.waits_for(f"the configuration of the run {bus.keys.run} from its learner")
        for answer in bus.ask(bus.keys.configuration, request, RunConfiguration):
            lifecycle.waits_for("")
            return _config_of(bus, answer, overrides)
        lifecycle.wait(ASK_AGAIN_S)
    return None


def _config_of(bus: Bus, answer: RunConfiguration, overrides: Sequence[str]) -> Config:
    where = f"the configuration of the run {bus.keys.run} from its learner"
    theirs = read_config(answer.text, (), where)
    if theirs.digest() != answer.digest or theirs.run.name != bus.keys.run:
        raise UserError(
            f"{where} is not what it was there: all processes of a run need the same vmdnn"
        )
    trusted = {override.partition("=")[2] for override in overrides}
    named = {
        "task.name": theirs.task.name,
        "simulator.backend": theirs.simulator.backend,
        "learner.pretraining.task": theirs.pretraining_task or "",
        **{f"evaluator.suites ({suite.name})": suite.backend for suite in theirs.suites},
    }
    for key, name in named.items():
        if ":" in name and name not in trusted:
            raise UserError(
                f"{where} names code to run, {key}={name}, which is not taken over the network."
                f" If you trust it: --set {key}={name}, or the run's config.yaml with --config"
            )
    return read_config(answer.text, overrides, where)


class Claim:
    """An actor's claim to its id, which holds until the bus is closed."""

    def __init__(self, bus: Bus) -> None:
        """Answer from now on who asks for this id."""
        self._bus = bus
        self._process = secrets.token_hex(16)
        self._joined = False
        bus.answer(bus.keys.identity(bus.id), Identity, lambda _: self._identity)

    def holds(self, lifecycle: Lifecycle) -> bool:
        """Whether no other living process has the id. Of those that join at once, one gets it."""
        if self._is_taken():
            return False
        lifecycle.wait(SETTLE_S)
        if self._is_taken():
            return False
        self._joined = True
        return True

    @property
    def _identity(self) -> Identity:
        return Identity(self._process, self._joined)

    def _is_taken(self) -> bool:
        key = self._bus.keys.identity(self._bus.id)
        others = self._bus.ask(key, self._identity, Identity)
        return any(
            other.process != self._process and (other.joined or other.process < self._process)
            for other in others
        )
