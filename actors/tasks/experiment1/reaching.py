"""Reaching and grasping without an obstacle, for pre-training of the vision (paper, section 4.1).

Everything is as in Experiment I, but nothing stands in the way. The tutor moves as it would over
the middle obstacle, so that sequences differ only in where the object is and how it lies.
"""

from __future__ import annotations

from actors.tasks.contract import Array
from actors.tasks.experiment1.plan import plan
from actors.tasks.experiment1.task import Experiment1
from actors.tasks.experiment1.world import GRID, MIDDLE
from proto.variables import Situation


class Reaching(Experiment1):
    """Experiment I without its obstacle: 3 positions by 5 orientations of the object."""

    name = "reaching"
    grid = {name: values for name, values in GRID.items() if name != "obstacle_x_m"}  # noqa: RUF012
    variables = tuple(each for each in Experiment1.variables if each.name != "obstacle_x_m")

    def plan(self, situation: Situation) -> Array:
        """The tutor's actions (124, 11), as over the middle obstacle."""
        return plan({**situation, "obstacle_x_m": MIDDLE["obstacle_x_m"]})
