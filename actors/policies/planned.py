"""Policies that execute a plan and do not use the picture: the tutor and the baselines."""

from __future__ import annotations

from typing import Final

import numpy as np

from actors.motion import execution_noise, ramp
from actors.tasks.contract import Array, Belief, Recollection, Task
from proto.config import TutorConfig
from proto.episode import Floats, Image
from proto.variables import Situation

CHANGE_STEPS: Final = 10
"""Control steps in which it goes over to another plan."""


class PlannedPolicy:
    """A `Policy` that executes the task's plan for the situation that it assumes.

    It is an `InformedPolicy`: when the situation changes, it goes over to the plan for what it
    assumes then.
    """

    version = 0
    looks = False
    outputs: Floats | None = None

    def __init__(
        self,
        name: str,
        task: Task,
        belief: Belief | Recollection,
        noise: TutorConfig | None = None,
    ) -> None:
        """Make a policy.

        Args:
            name: its name in files and results.
            task: task whose plans it executes.
            belief: maps the real situation to the situation that the policy assumes.
            noise: settings of the execution noise, which is added to the actions but not to the
                targets; None for no noise.
        """
        self.name = name
        self.target: Array | None = None
        self._task = task
        self._belief = belief
        self._noise = noise
        self._step = 0

    def begin(self, situation: Situation, seed: int) -> None:
        """Plan the episode.

        Args:
            situation: the real situation.
            seed: seed of the execution noise. The episode before is the one with the next smaller
                seed, whose situation the task draws; for seed 0 it is the one with seed 1.
        """
        self._seed = seed
        self._plan = self._task.plan(self._assumed(situation, seed))
        self._actions = self._plan
        if self._noise is not None:
            self._actions = self._plan + execution_noise(
                len(self._plan), seed, self._noise.noise_deg, self._noise.noise_correlation_steps
            )
        self._step = 0

    def change(self, situation: Situation) -> None:
        """Go over to the plan for the changed situation within CHANGE_STEPS control steps."""
        noise = self._actions - self._plan
        other = self._task.plan(self._assumed(situation, self._seed))
        share = ramp(len(other), self._step, CHANGE_STEPS)[:, None]
        self._plan = np.asarray(self._plan + (other - self._plan) * share)
        self._actions = self._plan + noise

    def _assumed(self, situation: Situation, seed: int) -> Situation:
        if isinstance(self._belief, Recollection):
            return self._belief.assume(situation, self._task.sample(abs(seed - 1)))
        return self._belief(situation)

    def step(self, image: Image) -> Array:  # noqa: ARG002 - it follows the plan
        """Return the next action (11,) of the plan."""
        self.target = self._plan[self._step]
        action: Array = self._actions[self._step]
        self._step += 1
        return action


def make_tutor(task: Task, noise: TutorConfig | None = None) -> PlannedPolicy:
    """Make the tutor, which knows the situation; with `noise` its execution is disturbed."""
    return PlannedPolicy("tutor", task, lambda situation: situation, noise)
