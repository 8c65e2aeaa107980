"""A policy that acts under guidance: the tutor limits its distance from the plan."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.policies.contract import InformedPolicy, ObservablePolicy, Policy
from proto.body import ACTION_SIZE, FOCUS, GRASP
from proto.episode import Floats, Image
from proto.variables import Situation

Array = NDArray[np.float64]

# Levels. They allow the policy to close the hand or to focus about one step early or late.
GRASP_SLACK: Final = 1.0
FOCUS_SLACK: Final = 1.5


class GuidedPolicy:
    """A policy whose actions are clipped to a range around the tutor's actions.

    The robot meets the situations that the policy's errors lead to, and the tutor's actions are
    recorded as targets for them (dataset aggregation; Ross et al. 2011). Because of the guidance
    every episode shows the whole behaviour, even if the policy is bad.

    Attributes:
        version: version of the policy.
        target: (11,) the tutor's action of the last step.
        outputs: always None, because the policy's outputs alone do not determine the action.
    """

    name = "guided"
    looks = True
    outputs: Floats | None = None

    def __init__(self, policy: Policy, tutor: Policy, guidance_deg: float) -> None:
        """Guide a policy.

        Args:
            policy: the policy that acts.
            tutor: the policy that guides.
            guidance_deg: largest difference between the actions of neck and arm and the tutor's
                (degrees).
        """
        self.version = policy.version
        self.target: Array | None = None
        self._policy = policy
        self._tutor = tutor
        self._slack = np.full(ACTION_SIZE, guidance_deg)
        self._slack[GRASP], self._slack[FOCUS] = GRASP_SLACK, FOCUS_SLACK

    def begin(self, situation: Situation, seed: int) -> None:
        """Start an episode for policy and tutor."""
        self._policy.begin(situation, seed)
        self._tutor.begin(situation, seed)

    def change(self, situation: Situation) -> None:
        """Tell policy and tutor that the situation has changed, if they can use it."""
        for each in (self._policy, self._tutor):
            if isinstance(each, InformedPolicy):
                each.change(situation)

    def step(self, image: Image) -> Array:
        """Return the policy's action (11,), clipped to the range around the tutor's action."""
        self.target = tutored = self._tutor.step(image)
        return self._policy.step(image).clip(tutored - self._slack, tutored + self._slack)

    def pfc(self) -> Floats | None:
        """Return the activity (units,) of the policy's PFC; None if it has none."""
        return self._policy.pfc() if isinstance(self._policy, ObservablePolicy) else None
