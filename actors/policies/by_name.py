"""Policies by name: the tutor, the baselines without eyes, and trained networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.motion import execution_noise
from actors.policies.contract import Policy
from actors.tasks.contract import Situation
from actors.tasks.experiment1.plan import plan
from actors.tasks.experiment1.task import OBJECT_Y_M, OBJECT_YAW_DEG, OBSTACLE_X_M
from learner.checkpoint import load_checkpoint
from learner.network_policy import NetworkPolicy
from learner.pretrained import checkpoint_path, pretrained_names
from proto.config import Config, TutorConfig
from proto.episode import Floats, Image
from proto.errors import UserError

Array = NDArray[np.float64]
Belief = Callable[[Situation], Situation]
"""What a policy without eyes takes a situation for."""


def _nearest(value: float, grid: tuple[float, ...]) -> float:
    return min(grid, key=lambda tutored: abs(tutored - value))


_MIDDLE: Final = {"obstacle_x_m": -0.27, "object_y_m": 0.25, "object_yaw_deg": 0.0}
"""The middle of the ranges; also what is planned for where a situation lacks a value."""

BASELINES: Final[Mapping[str, Belief]] = {
    # one fixed sequence, whatever the situation
    "replay": lambda _: _MIDDLE,
    # the right place, always the same orientation
    "yaw-blind": lambda situation: {**situation, "object_yaw_deg": 0.0},
    # the right object, always the same obstacle
    "obstacle-blind": lambda situation: {**situation, "obstacle_x_m": _MIDDLE["obstacle_x_m"]},
    # perfect sight, but only the 45 tutored sequences: what a network must pass to generalize
    "lookup": lambda situation: {
        "obstacle_x_m": _nearest(situation["obstacle_x_m"], OBSTACLE_X_M),
        "object_y_m": _nearest(situation["object_y_m"], OBJECT_Y_M),
        "object_yaw_deg": _nearest(situation["object_yaw_deg"], OBJECT_YAW_DEG),
    },
}


class PlannedPolicy:
    """Carries out the tutor's plan for what it believes the situation to be, without looking."""

    version = 0
    looks = False
    outputs: Floats | None = None

    def __init__(self, name: str, belief: Belief, noise: TutorConfig | None = None) -> None:
        """Make a policy; `noise` adds execution noise to the actions, never to the targets."""
        self.name = name
        self.target: Array | None = None
        self._belief = belief
        self._noise = noise
        self._step = 0

    def begin(self, situation: Situation, seed: int) -> None:
        """Plan the episode; `seed` is that of the execution noise."""
        self._plan = plan(self._belief({**_MIDDLE, **situation}))
        self._actions = self._plan
        if self._noise is not None:
            self._actions = self._plan + execution_noise(
                len(self._plan), seed, self._noise.noise_deg, self._noise.noise_correlation_steps
            )
        self._step = 0

    def step(self, image: Image) -> Array:  # noqa: ARG002
        """Next action (11,) of the plan."""
        self.target = self._plan[self._step]
        action: Array = self._actions[self._step]
        self._step += 1
        return action


def make_tutor(config: Config, *, noisy: bool) -> PlannedPolicy:
    """The tutor, who knows the situation; noisy for repeated tutoring of the same case."""
    return PlannedPolicy("tutor", lambda situation: situation, config.tutor if noisy else None)


def make_policy(name: str, config: Config) -> Policy:
    """Make the policy called `name`: tutor, a baseline, a path, or `pretrained:NAME`.

    Raises:
        UserError: there is no such policy or file.
    """
    if name == "tutor":
        return make_tutor(config, noisy=False)
    if name in BASELINES:
        return PlannedPolicy(name, BASELINES[name])
    path = checkpoint_path(name)
    if not path.is_file():
        raise UserError(
            f"policy {name!r}: no such policy or checkpoint file. There are: tutor, "
            f"{', '.join([*BASELINES, *pretrained_names()])}, or the path of a .safetensors"
            " checkpoint."
        )
    return _trained(path)


def _trained(path: Path) -> Policy:
    """VMDNN, or one of the networks that it is compared with."""
    checkpoint, origin = load_checkpoint(path), f"checkpoint {path}"
    if checkpoint.metadata.rival is None:
        return NetworkPolicy(checkpoint, origin)
    from learner.rivals.rival_policy import RivalPolicy  # noqa: PLC0415 - only this needs torch

    return RivalPolicy(checkpoint, origin)
