"""A policy whose pictures are changed, so that something is hidden from it."""

from __future__ import annotations

import numpy as np

from actors.policies.contract import InformedPolicy, Policy, StatefulPolicy
from actors.tasks.contract import Array, Blinding
from proto.episode import Image, States
from proto.errors import UserError
from proto.variables import Situation


class BlindedPolicy:
    """A `StatefulPolicy` that sees changed pictures. Recordings contain the real pictures."""

    def __init__(self, name: str, policy: Policy, blinding: Blinding) -> None:
        """Blind a policy.

        Args:
            name: name of the blinding, the first part of the policy's name.
            policy: the policy that acts.
            blinding: changes the pictures.
        """
        self.name = f"{name}-{policy.name}"
        self.version = policy.version
        self.looks = policy.looks
        self.target = policy.target
        self.outputs = policy.outputs
        self._policy = policy
        self._blinding = blinding
        self._step = 0

    def begin(self, situation: Situation, seed: int) -> None:
        """Start an episode."""
        self._policy.begin(situation, seed)
        self._step = 0

    def change(self, situation: Situation) -> None:
        """Tell the policy that the situation has changed, if it can use it."""
        if isinstance(self._policy, InformedPolicy):
            self._policy.change(situation)

    def step(self, image: Image) -> Array:
        """Return the policy's action (11,) for the changed picture."""
        action = self._policy.step(self._blinding(self._step, image))
        self.target, self.outputs = self._policy.target, self._policy.outputs
        self._step += 1
        return action

    def states(self, images: Image) -> States:
        """Return the activity (T, units) of each subnet for pictures (T, 48, 64) before the change.

        Raises:
            UserError: the policy has no states.
        """
        if not isinstance(self._policy, StatefulPolicy):
            raise UserError(f"policy {self.name!r} has no states; only networks have states")
        seen = [self._blinding(step, image) for step, image in enumerate(images)]
        return self._policy.states(np.stack(seen))
