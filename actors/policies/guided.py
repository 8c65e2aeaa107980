"""Tutoring a policy while it acts: the tutor lets it go its way, but not far."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.policies.contract import Policy
from proto.body import ACTION_SIZE, FOCUS, GRASP
from proto.episode import Floats, Image
from proto.variables import Situation

Array = NDArray[np.float64]

# Levels: enough to close the hand or to focus a step too early or too late, as learners do.
GRASP_SLACK: Final = 1.0
FOCUS_SLACK: Final = 1.5


class GuidedPolicy:
    """A policy acts; the tutor holds its actions near the plan, and means the plan.

    What is seen so is what the policy's own errors lead to; what is to be done there, the tutor
    says (dataset aggregation; Ross et al. 2011). As the tutor guides all the way, every episode
    shows the whole behaviour, however bad the policy.

    Attributes:
        version: that of the policy that acts.
        target: (11,) the tutor's action of the last step.
        outputs: always None; not they alone made the action.
    """

    name = "guided"
    looks = True
    outputs: Floats | None = None

    def __init__(self, policy: Policy, tutor: Policy, guidance_deg: float) -> None:
        """Guide `policy` so that neck and arm stay within guidance_deg of what the tutor does."""
        self.version = policy.version
        self.target: Array | None = None
        self._policy = policy
        self._tutor = tutor
        self._slack = np.full(ACTION_SIZE, guidance_deg)
        self._slack[GRASP], self._slack[FOCUS] = GRASP_SLACK, FOCUS_SLACK

    def begin(self, situation: Situation, seed: int) -> None:
        """Start an episode for both."""
        self._policy.begin(situation, seed)
        self._tutor.begin(situation, seed)

    def step(self, image: Image) -> Array:
        """Next action (11,): the policy's, as near to the tutor's as is asked."""
        self.target = meant = self._tutor.step(image)
        return self._policy.step(image).clip(meant - self._slack, meant + self._slack)
