"""A user's backend whose physics fails."""

from __future__ import annotations

import numpy as np

from actors.backends.sapien.simulator import SapienSimulator
from actors.simulator import Array, Scene, StepReport


class FailingSimulator(SapienSimulator):
    """Plays its first episode correctly; in all others the joints are NaN from step 3 on."""

    name = "failing"
    _episode = 0
    _step = 0

    def reset(self, scene: Scene) -> None:
        super().reset(scene)
        self._episode += 1
        self._step = 0

    def step(self, targets: Array) -> StepReport:
        self._step += 1
        return super().step(targets)

    def joints_deg(self) -> Array:
        joints = super().joints_deg()
        return joints if self._episode == 1 or self._step < 3 else np.full_like(joints, np.nan)
