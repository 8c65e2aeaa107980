"""What only the picture from outside shows besides the scene: a floor, and legs of the table."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from actors.simulator import Box, Pose, Scene

FLOOR_M: Final = -0.48
"""Height of the floor (world frame); the robot's feet stand on it."""
FLOOR_SIZE_M: Final = (3.2, 3.2, 0.02)
LEG_M: Final = 0.05
"""Thickness of a leg of the table."""
_FLOOR_COLOUR: Final = (0.30, 0.31, 0.33)
_LEG_COLOUR: Final = (0.45, 0.42, 0.38)
_TABLE: Final = "table"


def furnished(scene: Scene) -> Scene:
    """Return a scene for the picture from outside; its further boxes are not in the world."""
    floor = Pose((0.0, 0.0, FLOOR_M - FLOOR_SIZE_M[2] / 2))
    boxes = [Box("outside_floor", FLOOR_SIZE_M, floor, _FLOOR_COLOUR)]
    for table in scene.boxes:
        if table.name == _TABLE:
            boxes += _legs(table)
    return replace(scene, boxes=(*scene.boxes, *boxes))


def _legs(table: Box) -> list[Box]:
    x, y, z = table.pose.position_m
    top = z - table.size_m[2] / 2
    size = (LEG_M, LEG_M, top - FLOOR_M)
    across, along = ((table.size_m[axis] - LEG_M) / 2 for axis in (0, 1))
    places = [
        (x + i * across, y + j * along, (top + FLOOR_M) / 2) for i in (-1, 1) for j in (-1, 1)
    ]
    return [
        Box(f"outside_leg_{number}", size, Pose(place), _LEG_COLOUR)
        for number, place in enumerate(places)
    ]
