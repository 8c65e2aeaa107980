"""The task `reaching`: Experiment I without its obstacle, for pre-training (paper, section 4.1).

The tutor moves as over the obstacle in its middle position, so that sequences differ only in the
position and yaw of the object.
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
        """Return the tutor's actions (124, 11), those for the obstacle in its middle position."""
        return plan({**situation, "obstacle_x_m": MIDDLE["obstacle_x_m"]})
