"""A user's backend that kills its process in some situations, as a crash in native code does."""

from __future__ import annotations

import os
import signal
from typing import Final

from actors.backends.sapien.simulator import SapienSimulator
from actors.simulator import JointTargets, Scene, StepReport
from actors.tasks.registry import make_task
from proto.config import TaskConfig

TASK: Final = make_task(TaskConfig())
DEADLY_CASE: Final = 22
DEADLY_SEED: Final = 1003
_DEADLY_BOXES: Final = [
    TASK.scene(situation).boxes
    for situation in (TASK.tutored()[DEADLY_CASE], TASK.sample(DEADLY_SEED))
]


class DeadlySimulator(SapienSimulator):
    """Dies in the third step of the tutored case DEADLY_CASE and of the trial DEADLY_SEED."""

    name = "deadly"
    _steps_left: int | None = None

    def reset(self, scene: Scene) -> None:
        super().reset(scene)
        self._steps_left = 2 if scene.boxes in _DEADLY_BOXES else None

    def step(self, targets: JointTargets) -> StepReport:
        if self._steps_left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        if self._steps_left is not None:
            self._steps_left -= 1
        return super().step(targets)
