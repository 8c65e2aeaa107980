"""What a task is: situations, the scene each gives, and the reading of success."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from actors.simulator import Pose, Scene, StepReport
from proto.config import Attention
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
    """A task of the paper.

    Attributes:
        name: what it is called in configs and files.
        phases: (T,) uint8, subtask of each control step, counted from 1 as in the paper.
        start: (11,) action whose posture every episode starts from.
        attention: if fixed, neck and focus stay as in `start`, whatever the policy says.
    """

    name: str
    phases: NDArray[np.uint8]
    start: NDArray[np.float64]
    attention: Attention

    def tutored(self) -> Sequence[Situation]:
        """The situations that are tutored, always in the same order."""

    def sample(self, seed: int) -> Situation:
        """An unlearned situation, uniform inside the ranges; the same seed gives the same."""

    def corners(self) -> Sequence[Situation]:
        """The corners of the ranges."""

    def check(self, situation: Situation) -> None:
        """Raise UserError unless the situation has this task's values within its ranges."""

    def scene(self, situation: Situation) -> Scene:
        """The scene of a situation."""

    def judge(self, situation: Situation) -> Judge:
        """A judge for one episode of the situation."""
