"""The policy of a sequence that a person showed by hand."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from proto.episode import Floats, Image
from proto.variables import Situation

BY_HAND: Final = "by-hand"
"""Name of the policy in recordings of what a person showed."""


class ShownByHand:
    """A `Policy` that repeats the actions of a demonstration, brought to the task's phases.

    Attributes:
        version: version of the policy that was corrected, 0 if there was none.
    """

    name = BY_HAND
    looks = False
    target: NDArray[np.float64] | None = None
    outputs: Floats | None = None

    def __init__(self, actions: NDArray[np.float64], version: int) -> None:
        """Repeat actions (T, 11)."""
        self.version = version
        self._actions = actions
        self._step = 0

    def begin(self, situation: Situation, seed: int) -> None:  # noqa: ARG002 - the person saw it
        """Start an episode."""
        self._step = 0

    def step(self, image: Image) -> NDArray[np.float64]:  # noqa: ARG002 - the person has looked
        """Return the next action (11,)."""
        action: NDArray[np.float64] = self._actions[self._step]
        self._step += 1
        return action
