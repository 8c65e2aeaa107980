"""Policies that carry out the tutor's plan without looking: the tutor itself, and the baselines."""

from __future__ import annotations

from actors.motion import execution_noise
from actors.tasks.contract import Array, Belief, Task
from proto.config import TutorConfig
from proto.episode import Floats, Image
from proto.variables import Situation


class PlannedPolicy:
    """A `Policy` that carries out the plan for the situation that it believes in."""

    version = 0
    looks = False
    outputs: Floats | None = None

    def __init__(
        self, name: str, task: Task, belief: Belief, noise: TutorConfig | None = None
    ) -> None:
        """Make a policy.

        Args:
            name: what it is called in files and results.
            task: whose plans it carries out.
            belief: what it takes a situation for.
            noise: adds execution noise to the actions, never to the targets.
        """
        self.name = name
        self.target: Array | None = None
        self._task = task
        self._belief = belief
        self._noise = noise
        self._step = 0

    def begin(self, situation: Situation, seed: int) -> None:
        """Plan the episode; `seed` is that of the execution noise."""
        self._plan = self._task.plan(self._belief(situation))
        self._actions = self._plan
        if self._noise is not None:
            self._actions = self._plan + execution_noise(
                len(self._plan), seed, self._noise.noise_deg, self._noise.noise_correlation_steps
            )
        self._step = 0

    def step(self, image: Image) -> Array:  # noqa: ARG002 - it does not look
        """Next action (11,) of the plan."""
        self.target = self._plan[self._step]
        action: Array = self._actions[self._step]
        self._step += 1
        return action


def make_tutor(task: Task, noise: TutorConfig | None = None) -> PlannedPolicy:
    """The tutor, who knows the situation; with noise for repeated tutoring of the same case."""
    return PlannedPolicy("tutor", task, lambda situation: situation, noise)
