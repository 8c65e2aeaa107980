"""Zenoh keys of a run: all names under which processes exchange messages."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Role(StrEnum):
    """What a process does in a run."""

    HUB = "hub"
    ACTOR = "actor"
    LEARNER = "learner"
    EVALUATOR = "evaluator"
    RECORDER = "recorder"
    WATCH = "watch"

    @property
    def with_article(self) -> str:
        """Such as `an actor`, for messages to users."""
        return f"an {self}" if self[0] in "ae" else f"a {self}"


ANYONE = "*"
"""Matches every id in a subscription."""


@dataclass(frozen=True)
class Keys:
    """Keys of one run.

    Attributes:
        run: name of the run.
    """

    run: str

    @property
    def policy(self) -> str:
        """Learner to all: `PolicyVersion`."""
        return f"vmdnn/{self.run}/policy"

    @property
    def request_tutoring(self) -> str:
        """Actor asks the learner: `TutoringRequest`, answered by `TutoringCase` or `Correction`."""
        return f"vmdnn/{self.run}/request/tutoring"

    @property
    def request_trial(self) -> str:
        """Actor asks the evaluator: `TrialRequest`, answered by `Trial`."""
        return f"vmdnn/{self.run}/request/trial"

    @property
    def settings(self) -> str:
        """A process that joins asks learner and evaluator: `Settings`, answered by `Settings`."""
        return f"vmdnn/{self.run}/settings"

    def claim(self, role: Role | str) -> str:
        """A learner or evaluator asks others of its role: `Claim`, answered by `Claim`."""
        return f"vmdnn/{self.run}/claim/{role}"

    @property
    def configuration(self) -> str:
        """A process that joins asks the learner for the `RunConfiguration`."""
        return f"vmdnn/{self.run}/configuration"

    def identity(self, actor: str = ANYONE) -> str:
        """An actor that joins asks who else has its id: `Identity`, answered by `Identity`."""
        return f"vmdnn/{self.run}/identity/{actor}"

    @property
    def verdict(self) -> str:
        """Evaluator to learner: `Verdict`."""
        return f"vmdnn/{self.run}/verdict"

    def sequence(self, actor: str = ANYONE) -> str:
        """Actor to learner: `Sequence`."""
        return f"vmdnn/{self.run}/sequence/{actor}"

    def rollout(self, actor: str = ANYONE) -> str:
        """Actor to recorders: `Rollout`."""
        return f"vmdnn/{self.run}/rollout/{actor}"

    def outcome(self, actor: str = ANYONE) -> str:
        """Actor to evaluator: `EpisodeOutcome`."""
        return f"vmdnn/{self.run}/outcome/{actor}"

    def failure(self, actor: str = ANYONE) -> str:
        """Actor to learner and evaluator: `EpisodeFailed`."""
        return f"vmdnn/{self.run}/failure/{actor}"

    def receipt(self, role: Role | str, actor: str) -> str:
        """Learner, evaluator or recorder (`role`) to actor: `Receipt`."""
        return f"vmdnn/{self.run}/receipt/{role}/{actor}"

    def renamed(self, key: str, actor: str) -> str:
        """The key of this run under which an actor publishes what it kept under another run's name.

        Raises:
            ValueError: it is not the key of a sequence, a rollout, an outcome or a failure.
        """
        channel = key.split("/")[-2:-1]
        if channel not in (["sequence"], ["rollout"], ["outcome"], ["failure"]):
            raise ValueError(f"nothing is sent under the key {key!r}")
        return f"vmdnn/{self.run}/{channel[0]}/{actor}"

    def live(self, actor: str = ANYONE) -> str:
        """Actor to anyone: `Live`."""
        return f"vmdnn/{self.run}/live/{actor}"

    def pictures(self, actor: str = ANYONE) -> str:
        """Actor to anyone: `Pictures`."""
        return f"vmdnn/{self.run}/pictures/{actor}"

    def metrics(self, role: Role | str = ANYONE, process: str = ANYONE) -> str:
        """Every process to anyone: its `Metrics`."""
        return f"vmdnn/{self.run}/metrics/{role}/{process}"

    def alive(self, role: Role | str = ANYONE, process: str = ANYONE) -> str:
        """Liveliness token of every process."""
        return f"vmdnn/{self.run}/alive/{role}/{process}"

    def control(self, role: Role | str) -> str:
        """Anyone asks all processes of a role: `Control`, answered by `ControlReply`."""
        return f"vmdnn/{self.run}/control/{role}"
