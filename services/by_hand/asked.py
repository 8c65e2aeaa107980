"""What a person is asked to show."""

from __future__ import annotations

from dataclasses import dataclass

from actors.policies.contract import Policy
from actors.tasks.contract import Task
from proto.episode import Kind
from proto.suites import Conditions
from proto.variables import Situation


@dataclass(frozen=True)
class Asked:
    """A case to demonstrate, or a situation in which a policy is to be corrected.

    Attributes:
        name: what the page calls it.
        task: the task.
        situation: the values of the task's variables by name.
        seed: seed of the episode.
        actor: id of the process that plays it.
        config_digest: digest of the effective configuration.
        policy: the policy that is corrected; None if the person shows everything.
        training: id of the training that the policy comes from; empty if it came from a file.
        conditions: conditions of the suite that it belongs to.
    """

    name: str
    task: Task
    situation: Situation
    seed: int
    actor: str
    config_digest: str
    policy: Policy | None = None
    training: str = ""
    conditions: Conditions | None = None

    @property
    def kind(self) -> Kind:
        """The kind of the episode that is recorded."""
        return Kind.TUTORING if self.policy is None else Kind.CORRECTION

    @property
    def policy_words(self) -> str:
        """The policy in words; empty if there is none."""
        if self.policy is None:
            return ""
        return f"{self.policy.name}, version {self.policy.version}"
