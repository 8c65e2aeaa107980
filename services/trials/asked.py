"""Which trials this run asked for; no other trial is counted.

A trial is asked for by a lease, which names policy, situation and actor. Leases are in memory only.
An actor may still hold a finished trial when the evaluator has been restarted, and it must not be
lost. So a trial without a lease counts as asked for if a predecessor of this process may have asked
for it: if its policy had been published before this process heard of a newer one.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

from proto.messages import PolicyKey

Item = TypeVar("Item", bound=Hashable)


class NotYetError(Exception):
    """This process has not heard of a policy, but it may be one of the run."""


class AskedTrials(Generic[Item]):
    """The policies of this run, and the trials of them that actors were asked to play.

    Attributes:
        newest: the newest policy, or ("", 0) before any was heard of.
    """

    def __init__(
        self, counted_versions: Callable[[str], list[int]], *, has_predecessor: bool
    ) -> None:
        """Begin without leases.

        Args:
            counted_versions: gives the policy versions of a training whose trials were counted,
                by this process or a predecessor, oldest first.
            has_predecessor: whether another process evaluated this run before.
        """
        self._has_predecessor = has_predecessor
        self.newest: PolicyKey = ("", 0)
        self._first: PolicyKey | None = None
        self._given: set[tuple[PolicyKey, Item, str]] = set()
        self._counted_versions = counted_versions

    def publish(self, policy: PolicyKey) -> bool:
        """Note that a policy of this run was published; whether it is the newest."""
        run_id, version = self.newest
        if policy[0] == run_id and policy[1] <= version:
            return False
        self.newest = policy
        if self._first is None:
            self._first = policy
        return True

    def give(self, policy: PolicyKey, item: Item, actor: str) -> None:
        """Note that an actor was asked for a trial."""
        self._given.add((policy, item, actor))

    def policy_problem(self, policy: PolicyKey) -> str:
        """Return why a policy is none of this run; empty if it was published in it.

        Raises:
            NotYetError: it may have been published, but this process has not heard of it.
        """
        run_id, version = policy
        newest_run, newest_version = self.newest
        if self._first is None or (run_id == newest_run and version > newest_version):
            raise NotYetError
        if run_id == newest_run and version >= 1:
            return ""
        known = self._counted_versions(run_id)
        if known and 1 <= version <= known[-1]:
            return ""
        return f"no policy {version} of the training {run_id} was published in this run"

    def trial_problem(self, policy: PolicyKey, item: Item, actor: str) -> str:
        """Return why a trial of a published policy was not asked for; empty if it was."""
        if (policy, item, actor) in self._given or self._may_be_older(policy):
            return ""
        return f"this trial of policy {policy[1]} was not asked of {actor}"

    def _may_be_older(self, policy: PolicyKey) -> bool:
        """Whether a predecessor of this process may have handed out trials of a policy."""
        if self._first is None or not self._has_predecessor:
            return False
        first_run, first_version = self._first
        # Trainings change one after another: one that is not the first heard of came before it,
        # unless this process heard of its beginning.
        if policy[0] == first_run:
            return policy[1] <= first_version
        return policy[0] != self.newest[0]
