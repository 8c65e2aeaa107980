"""Reaching and grasping without an obstacle, which forms the vision (paper, section 4.1).

Everything is as in Experiment I, but nothing stands in the way. The tutor moves as it would over
the middle obstacle, so that what differs between sequences is only where the object is and how it
lies.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from actors.tasks.experiment1.task import GRID, Experiment1


class Reaching(Experiment1):
    """Experiment I without its obstacle: 3 positions by 5 orientations of the object."""

    name = "reaching"
    grid: ClassVar[Mapping[str, tuple[float, ...]]] = {
        name: GRID[name] for name in ("object_y_m", "object_yaw_deg")
    }
