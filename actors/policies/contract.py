"""What decides the robot's actions: the tutor, a baseline or a trained network."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from proto.episode import Floats, Image, States
from proto.variables import Situation


class Policy(Protocol):
    """Chooses one action each control step.

    Attributes:
        name: what it is called in files and results.
        version: policy version; 0 for what was never trained.
        looks: whether it uses the picture; if not, nothing need be rendered.
        target: (11,) what the last action was meant to be, where noise was added to it; else None.
        outputs: (110,) softmax outputs behind the last action, or None.
    """

    name: str
    version: int
    looks: bool
    target: NDArray[np.float64] | None
    outputs: Floats | None

    def begin(self, situation: Situation, seed: int) -> None:
        """Start an episode. Only the tutor and the baselines may look at the situation."""

    def step(self, image: Image) -> NDArray[np.float64]:
        """Next action (11,), see `proto.body`, for the picture (48, 64) uint8 seen now."""


@runtime_checkable
class StatefulPolicy(Policy, Protocol):
    """A policy whose inside can be looked into."""

    def states(self, images: Image) -> States:
        """Activity (T, units) of its parts by name, in an episode with the pictures images."""
