"""What decides the robot's actions: the tutor, a baseline or a trained network."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from actors.tasks.task import Situation
from proto.episode import Image


class Policy(Protocol):
    """Chooses one action each control step."""

    name: str
    version: int
    """Policy version; 0 for what was never trained."""

    def begin(self, situation: Situation, seed: int) -> None:
        """Start an episode. Only the tutor and the baselines may look at the situation."""

    def step(self, image: Image) -> NDArray[np.float64]:
        """Next action (11,), see `proto.action`, for the picture (48, 64) uint8 seen now."""
