"""Experiment I of the paper (section 4.2): reach over an obstacle, grasp a box, lift it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import ClassVar

from actors.simulator import Scene
from actors.tasks.contract import Array, Task
from actors.tasks.experiment1 import world
from actors.tasks.experiment1.baselines import BASELINES
from actors.tasks.experiment1.figure_words import FIGURE_WORDS
from actors.tasks.experiment1.judge import Experiment1Judge
from actors.tasks.experiment1.plan import plan
from proto.variables import Continuous, Question, Situation


def _variable(name: str, values: Sequence[float]) -> Continuous:
    return Continuous(name, min(values), max(values), unit=name.rpartition("_")[2])


class Experiment1(Task):
    """Experiment I. The tutored situations are a grid; random situations are uniform in its ranges.

    Attributes:
        grid: the tutored values of each variable.
    """

    name = "experiment1"
    grid: ClassVar[Mapping[str, tuple[float, ...]]] = world.GRID
    variables = tuple(_variable(name, values) for name, values in world.GRID.items())
    subtasks = world.SUBTASKS
    start = world.START
    questions = (Question("object_y_m", 3), Question("object_yaw_deg", 5))
    baselines = BASELINES
    figure_words = FIGURE_WORDS
    pushed_variable = "object_y_m"
    turned_variable = "object_yaw_deg"
    disturbed_phase = "reach above object"

    def tutored(self) -> Sequence[Situation]:
        """Return all situations of the grid, 45 in Experiment I."""
        return [
            dict(zip(self.grid, values, strict=True)) for values in product(*self.grid.values())
        ]

    def scene(self, situation: Situation) -> Scene:
        """Return the scene with table, obstacle and object."""
        return world.scene(situation)

    def plan(self, situation: Situation) -> Array:
        """Return the tutor's actions (124, 11)."""
        return plan(situation)

    def judge(self, situation: Situation) -> Experiment1Judge:
        """Return a judge for one episode in a situation."""
        return Experiment1Judge(situation)
