"""The interface of policies, which choose the robot's actions."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from proto.episode import Floats, Image, States
from proto.variables import Situation


class Policy(Protocol):
    """Chooses one action in each control step.

    Attributes:
        name: its name in files and results.
        version: policy version; 0 if it is not trained.
        looks: whether it uses the picture. If not, the picture need not be rendered.
        target: (11,) the action to learn in place of the last action, such as the action before
            noise was added; None if the last action itself is to be learned.
        outputs: (110,) softmax outputs from which the last action was decoded, or None.
    """

    name: str
    version: int
    looks: bool
    target: NDArray[np.float64] | None
    outputs: Floats | None

    def begin(self, situation: Situation, seed: int) -> None:
        """Start an episode. Only the tutor and the baselines may use the situation."""

    def step(self, image: Image) -> NDArray[np.float64]:
        """Return the action (11,) for the current picture (48, 64) uint8, see `proto.body`."""


@runtime_checkable
class StatefulPolicy(Policy, Protocol):
    """A policy whose internal states can be recorded."""

    def states(self, images: Image) -> States:
        """Return the activity (T, units) of each subnet by name in an episode.

        Args:
            images: (T, 48, 64) uint8, the pictures of the episode.
        """


@runtime_checkable
class ObservablePolicy(Policy, Protocol):
    """A policy whose PFC can be watched while it acts."""

    def pfc(self) -> Floats | None:
        """Return the activity (units,) of the PFC after the last step; None if it has no PFC."""


@runtime_checkable
class InformedPolicy(Policy, Protocol):
    """A policy that knows the situation, such as the tutor, and learns when it changes."""

    def change(self, situation: Situation) -> None:
        """Take note that an outside hand has changed the situation; called between two steps."""
