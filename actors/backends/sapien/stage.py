"""Pictures of the world: a copy of its bodies that is moved to where they are when needed.

Rendering is kept apart from the physics, so that a machine without any graphics driver can still
run scenes, and the same world can be drawn in two ways: quickly for the robot's eye, and with all
details from outside.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import sapien
from numpy.typing import NDArray
from sapien import render

from actors.simulator import Box
from sim_assets.icub_visuals import Visual

Picture = NDArray[np.uint8]

# Mesa's software renderer otherwise starts a thread for each core, and actors fight for them.
os.environ.setdefault("LP_NUM_THREADS", "0")

SHADER: Final = Path(__file__).parent / "shader"
NEAR_M: Final = 0.01
FAR_M: Final = 5.0


class Stage:
    """Bodies made of shapes under a light that never changes (see `shader/`)."""

    def __init__(self, robot: Iterable[Visual]) -> None:
        render.set_picture_format("Color", "r8g8b8a8unorm")  # a quarter of the usual floats
        self._system = render.RenderSystem()
        self._scene = sapien.Scene([self._system])
        shapes: dict[str, list[Any]] = {}
        for visual in robot:
            shapes.setdefault(visual.link, []).append(_mesh_shape(visual))
        self._robot = {link: self._add(parts) for link, parts in shapes.items()}
        self._boxes: dict[str, sapien.Entity] = {}
        self._cameras: dict[tuple[int, int], Any] = {}

    def set_boxes(self, boxes: Iterable[Box]) -> None:
        """Replace the boxes by those of another scene."""
        for entity in self._boxes.values():
            self._scene.remove_entity(entity)
        self._boxes = {box.name: self._add([_box_shape(box)]) for box in boxes}

    def place(self, poses: Mapping[str, sapien.Pose]) -> None:
        """Move every body to its pose."""
        for name, entity in self._robot.items():
            entity.set_pose(poses[name])
        for name, entity in self._boxes.items():
            entity.set_pose(poses[name])

    def picture(
        self, eye: sapien.Pose, width: int, height: int, focal: tuple[float, float]
    ) -> Picture:
        """Take a picture (height, width, 4) uint8: sRGB colours, and what is not sky.

        Where no body is seen, all four values are 0; elsewhere the last is 255.

        Args:
            eye: x along the optical axis, y left, z up.
            width: pixels across.
            height: pixels down.
            focal: focal lengths in these pixels, across and down.
        """
        camera = self._camera(width, height)
        camera.entity.set_pose(eye)
        camera.set_perspective_parameters(NEAR_M, FAR_M, *focal, width / 2, height / 2, 0.0)
        self._system.step()
        camera.take_picture()
        return np.asarray(camera.get_picture("Color"))

    def _camera(self, width: int, height: int) -> Any:
        if (width, height) not in self._cameras:
            entity = sapien.Entity()
            camera = render.RenderCameraComponent(width, height, str(SHADER))
            entity.add_component(camera)
            self._scene.add_entity(entity)
            self._cameras[width, height] = camera
        return self._cameras[width, height]

    def _add(self, shapes: Iterable[Any]) -> sapien.Entity:
        entity = sapien.Entity()
        body = render.RenderBodyComponent()
        for shape in shapes:
            body.attach(shape)
        entity.add_component(body)
        self._scene.add_entity(entity)
        return entity


def looking_at(place_m: Sequence[float], target_m: Sequence[float]) -> sapien.Pose:
    """Pose at a place, x towards a target that is not straight above or below, z upwards."""
    x = np.subtract(target_m, place_m)
    x /= np.linalg.norm(x)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
    matrix[:3, 3] = place_m
    return sapien.Pose(matrix)


def _box_shape(box: Box) -> Any:
    return render.RenderShapeBox(np.array(box.size_m) / 2, _material(box.colour))


def _mesh_shape(visual: Visual) -> Any:
    return render.RenderShapeTriangleMesh(str(visual.mesh), [1.0] * 3, _material(visual.colour))


def _material(colour: Sequence[float]) -> Any:
    """A matt material of a colour in 0..1."""
    return render.RenderMaterial(base_color=[*colour, 1.0])
