"""Pictures of the world: a copy of its bodies that is moved to where they are when needed.

Rendering is kept apart from the physics, so that a machine without any graphics driver can still
run scenes, and the same world can be drawn in two ways: quickly for the robot's eye, and with all
details from outside.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import sapien
from sapien import render

from actors.backends.eye import FAR_M, NEAR_M
from actors.simulator import Box, Image
from sim_assets.icub_visuals import Visual

SHADER: Final = Path(__file__).parent / "shader"


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
    ) -> Image:
        """Rendered picture (height, width, 4) uint8, as `actors.backends.eye` describes it.

        Args:
            eye: pose of the camera: x along the optical axis, y left, z up.
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


def _box_shape(box: Box) -> Any:
    return render.RenderShapeBox(np.array(box.size_m) / 2, _material(box.colour))


def _mesh_shape(visual: Visual) -> Any:
    return render.RenderShapeTriangleMesh(str(visual.mesh), [1.0] * 3, _material(visual.colour))


def _material(colour: Sequence[float]) -> Any:
    """A matt material of a colour in 0..1."""
    return render.RenderMaterial(base_color=[*colour, 1.0])
