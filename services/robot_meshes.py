"""The robot's meshes as a message, so that viewers show the robot in a recording."""

from __future__ import annotations

from functools import cache
from typing import Any, Final

import numpy as np

from actors.backends.robot import build_robot
from proto.recordings.schemas import SceneUpdate
from proto.recordings.viewing import set_colour
from sim_assets.built_visuals import Visual

GRID_M: Final = 2.0**-11
"""Vertices lie on a grid of half a millimetre: such numbers are packed well."""


@cache
def robot_meshes() -> SceneUpdate:
    """Return the robot, each mesh in the frame of its link, which moves with it.

    Raises:
        UserError: the robot's model can neither be read nor built.
    """
    update = SceneUpdate()
    entities: dict[str, Any] = {}
    for visual in build_robot().seen_in_recordings:
        link = visual.link
        if link not in entities:
            entities[link] = update.entities.add(frame_id=link, id=link, frame_locked=True)
        _add_triangles(entities[link].triangles.add(), visual)
    return update


def _add_triangles(triangles: Any, visual: Visual) -> None:
    import trimesh  # noqa: PLC0415 - it takes a second, and few of those who could show the robot do

    mesh = trimesh.load_mesh(visual.mesh)
    mesh.merge_vertices(merge_norm=True)
    triangles.pose.orientation.w = 1.0
    for x, y, z in (np.rint(mesh.vertices / GRID_M) * GRID_M).tolist():
        triangles.points.add(x=x, y=y, z=z)
    triangles.indices.extend(mesh.faces.ravel().tolist())
    set_colour(triangles.color, visual.colour)
