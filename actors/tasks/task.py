"""What a task is: situations, the scene each gives, and the reading of success."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from actors.simulator import JointTargets, Pose, Scene, StepReport
from proto.episode import Outcome

Situation = Mapping[str, float]
"""Named values of one situation, in the paper's task frame (m and degrees)."""


class Judge(Protocol):
    """Watches one episode and reads its success."""

    def watch(
        self, report: StepReport, joints_deg: NDArray[np.float64], bodies: Mapping[str, Pose]
    ) -> None:
        """Take note of one control step that has just been run."""

    def outcome(self) -> Outcome:
        """How the episode went, once its last step was watched."""


class Task(Protocol):
    """A task of the paper."""

    name: str

    def tutored(self) -> Sequence[Situation]:
        """The situations that are tutored, always in the same order."""

    def sample(self, seed: int) -> Situation:
        """An unlearned situation, uniform inside the ranges; the same seed gives the same."""

    def corners(self) -> Sequence[Situation]:
        """The corners of the ranges."""

    def check(self, situation: Situation) -> None:
        """Raise UserError unless the situation has this task's values within its ranges."""

    def scene(self, situation: Situation, start: JointTargets) -> Scene:
        """The scene of a situation, the robot starting at `start`."""

    def judge(self, situation: Situation) -> Judge:
        """A judge for one episode of the situation."""
