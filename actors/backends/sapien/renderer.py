"""Draws the world with SAPIEN: a copy of its bodies, moved to their poses before each picture.

Rendering is separate from the physics for two reasons. A machine without a graphics driver can
still run scenes. And the same world can be drawn in two ways: quickly for the robot's eye, and in
full detail from outside.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import sapien
from sapien import render

from actors.backends import light
from actors.backends.eye import FAR_M, NEAR_M
from actors.simulator import Box, Image, Scene, Screen
from sim_assets.built_visuals import Visual

SHADERS: Final = Path(__file__).parent / "shader"


@dataclass
class _ShownScreen:
    """A screen in the rendered scene.

    Attributes:
        screen: what it shows.
        entity: its body.
        texture: the frame that it shows now.
        step: control step of that frame.
    """

    screen: Screen
    entity: sapien.Entity
    texture: Any
    step: int = 0

    def show(self, step: int) -> None:
        """Show the frame of a control step."""
        if step != self.step:
            self.texture.upload(_texels(self.screen.frame(step)))
            self.step = step


class Renderer:
    """The robot in one set of meshes, boxes and screen, in the light of `actors.backends.light`."""

    def __init__(self, robot: Iterable[Visual], *, shadows: bool) -> None:
        render.set_picture_format("Color", "r8g8b8a8unorm")  # a quarter of the usual floats
        self._system = render.RenderSystem()
        self._scene = sapien.Scene([self._system])
        self._shader = SHADERS / ("outside" if shadows else "eye")
        if shadows:
            self._scene.add_entity(_sun())
        shapes: dict[str, list[Any]] = {}
        for visual in robot:
            shapes.setdefault(visual.link, []).append(_mesh_shape(visual))
        self._robot = {link: self._add(parts) for link, parts in shapes.items()}
        self._boxes: dict[str, sapien.Entity] = {}
        self._screen: _ShownScreen | None = None
        self._cameras: dict[tuple[int, int], Any] = {}

    def set_scene(self, scene: Scene) -> None:
        """Replace all boxes and the screen."""
        for entity in self._boxes.values():
            self._scene.remove_entity(entity)
        if self._screen is not None:
            self._scene.remove_entity(self._screen.entity)
        self._boxes = {box.name: self._add([_box_shape(box)]) for box in scene.boxes}
        for box in scene.boxes:
            pose = sapien.Pose(box.pose.position_m, box.pose.quaternion)
            self._boxes[box.name].set_pose(pose)
        self._screen = None if scene.screen is None else self._screen_of(scene.screen)

    def place(self, poses: Mapping[str, sapien.Pose], step: int) -> None:
        """Move every body to its pose, and show the screen's frame of a control step."""
        for name, entity in self._robot.items():
            entity.set_pose(poses[name])
        for name, entity in self._boxes.items():
            if name in poses:
                entity.set_pose(poses[name])
        if self._screen is not None:
            self._screen.show(step)

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
            camera = render.RenderCameraComponent(width, height, str(self._shader))
            entity.add_component(camera)
            self._scene.add_entity(entity)
            self._cameras[width, height] = camera
        return self._cameras[width, height]

    def _screen_of(self, screen: Screen) -> _ShownScreen:
        texture = _texture(screen.frame(0))
        entity = self._add([_screen_shape(screen, texture)])
        entity.set_pose(sapien.Pose(screen.pose.position_m, screen.pose.quaternion))
        return _ShownScreen(screen, entity, texture)

    def _add(self, shapes: Iterable[Any]) -> sapien.Entity:
        entity = sapien.Entity()
        body = render.RenderBodyComponent()
        for shape in shapes:
            body.attach(shape)
        entity.add_component(body)
        self._scene.add_entity(entity)
        return entity


def _sun() -> sapien.Entity:
    """A light that tells the shader what the sun sees; its colour is the shader's own."""
    sun = render.RenderDirectionalLightComponent()
    sun.shadow = True
    sun.shadow_half_size = light.SHADOWS_RADIUS_M
    sun.shadow_near, sun.shadow_far = -light.SHADOWS_RADIUS_M, light.SHADOWS_RADIUS_M
    sun.shadow_map_size = light.SHADOW_MAP_SIZE
    entity = sapien.Entity()
    entity.add_component(sun)
    from_sun = -np.array(light.TO_SUN)
    turn = sapien.math.shortest_rotation([1.0, 0.0, 0.0], from_sun)
    entity.set_pose(sapien.Pose(light.SHADOWS_CENTRE_M, turn))
    return entity


def _box_shape(box: Box) -> Any:
    return render.RenderShapeBox(np.array(box.size_m) / 2, _material(box.colour))


def _mesh_shape(visual: Visual) -> Any:
    return render.RenderShapeTriangleMesh(str(visual.mesh), [1.0] * 3, _material(visual.colour))


def _screen_shape(screen: Screen, texture: Any) -> Any:
    """A rectangle that faces -y; the shader draws what has an emission texture as it is."""
    material = render.RenderMaterial()
    material.emission_texture = texture
    x, z = screen.size_m[0] / 2, screen.size_m[1] / 2
    corners = np.array([[-x, 0, -z], [x, 0, -z], [x, 0, z], [-x, 0, z]], dtype=np.float32)
    normals = np.tile(np.array([0, -1, 0], dtype=np.float32), (4, 1))
    places_in_frame = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype=np.float32)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32)
    return render.RenderShapeTriangleMesh(corners, triangles, normals, places_in_frame, material)


def _texture(frame: Image) -> Any:
    """A texture of a grey frame (height, width) uint8 that is drawn without gamma correction."""
    return render.RenderTexture2D(_texels(frame), "r8unorm", 1, "linear", "edge", False)


def _texels(frame: Image) -> Image:
    return np.ascontiguousarray(frame[..., None])


def _material(colour: Sequence[float]) -> Any:
    """A matt material of a colour in 0..1."""
    return render.RenderMaterial(base_color=[*colour, 1.0])
