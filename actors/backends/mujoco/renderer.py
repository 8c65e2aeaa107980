"""Draws the world with MuJoCo's renderer: a copy of its bodies, moved to their poses each time.

Rendering is separate from the physics for two reasons. A machine without a graphics driver can
still run scenes. And the same world can be drawn in two ways: quickly for the robot's eye, and in
full detail from outside.

MuJoCo cannot be given a shader, and what it draws is linear in the light, with 8 bits. Pictures are
not (see `actors.backends.light`): a nearly black hand would be left with a few levels. So bodies
are drawn in codes instead of colours. The red of a code is the brightness of the surface; green
divided by red is the number of the colour in a palette. A table then gives the colour that is seen
for each red and green. A screen has a red that no lit surface has, and its grey level as green.
"""

from __future__ import annotations

import atexit
import functools
import weakref
from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from actors.backends import light
from actors.backends.eye import FAR_M, NEAR_M
from actors.backends.mujoco import graphics
from actors.simulator import Array, Bodies, Image, Scene, Screen
from proto.errors import UserError
from sim_assets.built_visuals import Colour, Visual

PALETTE_STEPS: Final = 24
"""Green divided by red is (n + 1) / PALETTE_STEPS for number n of the palette."""
SCREEN_RED: Final = 16
"""Red of a screen's code. The least red of a lit surface is 255 * light.GROUND = 89."""

_SCREEN: Final = "screen"
_UNUSED_FLAGS: Final = (
    mujoco.mjtRndFlag.mjRND_REFLECTION,
    mujoco.mjtRndFlag.mjRND_SKYBOX,
    mujoco.mjtRndFlag.mjRND_FOG,
    mujoco.mjtRndFlag.mjRND_HAZE,
)

_open: weakref.WeakSet[Renderer] = weakref.WeakSet()


class Renderer:
    """The robot in one set of meshes, boxes and screen, in the light of `actors.backends.light`."""

    def __init__(
        self, robot: Sequence[Visual], scene: Scene, driver: str, *, shadows: bool
    ) -> None:
        """Load the robot's meshes into the graphics driver.

        Args:
            robot: the robot's meshes.
            scene: the first scene.
            driver: the driver, see `graphics.find_driver`.
            shadows: whether the sun casts shadows.
        """
        self._shadows = shadows
        self._colours = sorted({visual.colour for visual in robot})
        self._frame_shape = _frame_shape(scene.screen)
        self._screen_size = None if scene.screen is None else scene.screen.size_m
        self._model = _compile(robot, self._colours, scene.screen, shadows=shadows)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)  # the light never changes
        self._links = [self._model.body(number).name for number in range(1, self._model.nbody)]
        if scene.screen is not None:
            self._links.remove(_SCREEN)  # the last body
        self._gl: Any = graphics.open_context(driver)
        _open.add(self)
        # Registered after the driver's own exit handler, so that it runs before.
        atexit.unregister(_close_all)
        atexit.register(_close_all)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._options = mujoco.MjvOption()
        self._unused_camera = mujoco.MjvCamera()
        self.set_scene(scene)

    def fits(self, scene: Scene) -> bool:
        """Whether `set_scene` accepts a scene: its screen must have the shape of the first's."""
        size = None if scene.screen is None else scene.screen.size_m
        return self._screen_size == size and self._frame_shape == _frame_shape(scene.screen)

    def set_scene(self, scene: Scene) -> None:
        """Replace all boxes and the screen."""
        self._boxes = scene.boxes
        self._screen = scene.screen
        self._shown_step: int | None = None
        palette = self._colours + sorted({box.colour for box in scene.boxes} - {*self._colours})
        if len(palette) > PALETTE_STEPS:
            raise UserError(
                f"MuJoCo draws at most {PALETTE_STEPS} colours, but robot and boxes have"
                f" {len(palette)}: give some boxes the same colour"
            )
        self._box_codes = [_code(palette.index(box.colour)) for box in scene.boxes]
        self._table = _table_of(tuple(palette))
        self._drawn = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + len(scene.boxes))
        for flag in _UNUSED_FLAGS:
            self._drawn.flags[flag] = 0
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._shadows

    def place(self, poses: Bodies, step: int) -> None:
        """Move every body to its pose, and show the screen's frame of a control step."""
        rows = poses.rows[[poses.places[name] for name in self._links]]
        self._data.mocap_pos[: len(rows)] = rows[:, :3]
        self._data.mocap_quat[: len(rows)] = rows[:, 3:]
        if self._screen is not None and step != self._shown_step:
            self._show(self._screen, step)
        mujoco.mj_kinematics(self._model, self._data)
        self._poses = poses

    def picture(self, eye: Array, width: int, height: int, focal: tuple[float, float]) -> Image:
        """Rendered picture (height, width, 4) uint8, as `actors.backends.eye` describes it.

        Args:
            eye: pose (4, 4) of the camera in the world: x along the optical axis, y left, z up.
            width: pixels across.
            height: pixels down.
            focal: focal lengths in these pixels, across and down. MuJoCo draws with their mean: its
                pixels are square. Those of a crop differ by half a percent, as its size is rounded.
        """
        down = height / sum(focal)
        if not self._shadows:  # what lies outside may cast a shadow into the picture
            self._hide_bodies_outside(eye, down * width / height, down)
        self._collect()
        for camera in self._drawn.camera:
            camera.pos, camera.forward, camera.up = eye[:3, 3], eye[:3, 0], eye[:3, 2]
            camera.frustum_near, camera.frustum_far = NEAR_M, FAR_M
            # Its width follows from the shape of the picture.
            camera.frustum_top = NEAR_M * down
            camera.frustum_bottom = -camera.frustum_top
        self._gl.make_current()
        if width > self._context.offWidth or height > self._context.offHeight:
            mujoco.mjr_resizeOffscreen(width, height, self._context)
        view = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(view, self._drawn, self._context)
        codes = np.empty((height, width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(codes, None, view, self._context)
        places = codes[::-1, :, 0].astype(np.intp)  # in the flat table, row by row of red
        places *= 256
        places += codes[::-1, :, 1]
        return self._table.take(places).view(np.uint8).reshape(height, width, 4)

    def close(self) -> None:
        """Free what the graphics driver holds."""
        if self._gl is not None:
            # Else objects of another renderer are freed, which have the same numbers.
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None
            _open.discard(self)

    def __del__(self) -> None:
        """Free what the graphics driver holds, unless creating it has failed."""
        if getattr(self, "_context", None) is not None:
            self.close()

    def _hide_bodies_outside(self, eye: Array, across: float, down: float) -> None:
        """Leave out bodies whose bounding spheres lie outside the picture: every third triangle.

        Args:
            eye: pose (4, 4) of the camera.
            across: tangent of half the angle of view.
            down: the same from top to bottom.
        """
        radii = self._model.geom_rbound
        forward, left, up = ((self._data.geom_xpos - eye[:3, 3]) @ eye[:3, :3]).T
        inside = forward > -radii
        for offset, tangent in ((left, across), (up, down)):
            inside &= np.abs(offset) <= tangent * forward + radii * np.hypot(1, tangent)
        self._model.geom_rgba[:, 3] = inside

    def _collect(self) -> None:
        """Tell MuJoCo's renderer what to draw."""
        poses = self._poses
        mujoco.mjv_updateScene(
            self._model,
            self._data,
            self._options,
            None,
            self._unused_camera,
            mujoco.mjtCatBit.mjCAT_ALL,
            self._drawn,
        )
        rotation = np.empty(9)
        for box, code in zip(self._boxes, self._box_codes, strict=True):
            row = np.array([*box.pose.position_m, *box.pose.quaternion])
            if box.name in poses.places:
                row = poses.rows[poses.places[box.name]]
            mujoco.mju_quat2Mat(rotation, row[3:])
            geom = self._drawn.geoms[self._drawn.ngeom]
            half = np.array(box.size_m) / 2
            mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_BOX, half, row[:3], rotation, code)
            self._drawn.ngeom += 1

    def _show(self, screen: Screen, step: int) -> None:
        self._data.mocap_pos[-1] = screen.pose.position_m
        self._data.mocap_quat[-1] = screen.pose.quaternion
        self._model.tex_data[:] = _texels(screen.frame(step)).ravel()
        self._gl.make_current()
        mujoco.mjr_uploadTexture(self._model, self._context, 0)
        self._shown_step = step


def _close_all() -> None:
    for renderer in list(_open):
        renderer.close()


def _frame_shape(screen: Screen | None) -> tuple[int, ...] | None:
    return None if screen is None else screen.frames.shape[1:]


def _compile(
    robot: Sequence[Visual], colours: list[Colour], screen: Screen | None, *, shadows: bool
) -> Any:
    """A model with a body for each link that is drawn, and one for the screen."""
    spec = mujoco.MjSpec()
    _add_light(spec, shadows=shadows)
    spec.visual.quality.offsamples = 0  # blended codes would be the codes of other colours
    bodies: dict[str, Any] = {}
    for number, visual in enumerate(robot):
        mesh = trimesh.load_mesh(visual.mesh, process=False)
        asset = spec.add_mesh(name=str(number), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        asset.uservert = mesh.vertices.ravel()
        asset.usernormal = mesh.vertex_normals.ravel()
        asset.userface = mesh.faces.ravel()
        if visual.link not in bodies:
            bodies[visual.link] = spec.worldbody.add_body(name=visual.link, mocap=True)
        geom = _add_mesh_geom(bodies[visual.link], asset.name)
        geom.rgba = _code(colours.index(visual.colour))
    if screen is not None:
        _add_screen(spec, screen)
    return spec.compile()


def _add_mesh_geom(body: Any, mesh: str) -> Any:
    return body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, contype=0, conaffinity=0, mass=0
    )


def _add_screen(spec: Any, screen: Screen) -> None:
    """A rectangle that faces -y, with a texture of the frame and a border of one pixel around it.

    MuJoCo repeats textures; without the border, the frame's edges would blend with the opposite.
    """
    texels = _texels(screen.frame(0))
    height, width, channels = texels.shape
    texture = spec.add_texture(
        name=_SCREEN,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        colorspace=mujoco.mjtColorSpace.mjCOLORSPACE_LINEAR,
        width=width,
        height=height,
        nchannel=channels,
    )
    texture.data = texels.tobytes()
    # Emission 1 is the greatest brightness, whatever the light, so the texture is drawn as it is.
    material = spec.add_material(name=_SCREEN, emission=1.0, specular=0.0, rgba=[1, 1, 1, 1])
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = _SCREEN
    x, z = screen.size_m[0] / 2, screen.size_m[1] / 2
    left, right, top, bottom = 1 / width, 1 - 1 / width, 1 / height, 1 - 1 / height
    asset = spec.add_mesh(name=_SCREEN, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    asset.uservert = [-x, 0, -z, x, 0, -z, x, 0, z, -x, 0, z]
    asset.usernormal = [0, -1, 0] * 4
    asset.usertexcoord = [left, bottom, right, bottom, right, top, left, top]
    asset.userface = [0, 1, 2, 0, 2, 3]
    geom = _add_mesh_geom(spec.worldbody.add_body(name=_SCREEN, mocap=True), _SCREEN)
    geom.material = _SCREEN


def _texels(frame: Image) -> Image:
    """The codes (height + 2, width + 2, 3) of a frame (height, width) with a border around it."""
    grey = np.pad(frame, 1, mode="edge")
    return np.stack([np.full_like(grey, SCREEN_RED), grey, np.zeros_like(grey)], axis=2)


def _code(number: int) -> NDArray[np.float32]:
    """Red, green, blue and opacity of a palette's colour in full light."""
    return np.array([1.0, (number + 1) / PALETTE_STEPS, 0.0, 1.0], dtype=np.float32)


@functools.lru_cache(maxsize=8)
def _table_of(palette: tuple[Colour, ...]) -> NDArray[np.uint32]:
    """What is seen where a code was drawn: table[red, green] is four bytes of a rendered picture.

    See `actors.backends.eye` for rendered pictures.
    """
    red, green = np.meshgrid(np.arange(256), np.arange(256), indexing="ij")
    numbers = np.rint(green / np.maximum(red, 1) * PALETTE_STEPS).astype(int) - 1
    bases = np.array(palette)[np.clip(numbers, 0, len(palette) - 1)]
    seen = np.zeros((256, 256, 4), dtype=np.uint8)
    seen[..., :3] = np.rint(255 * (red[..., None] / 255 * bases) ** (1 / light.GAMMA))
    seen[..., 3] = 255
    seen[: 2 * SCREEN_RED] = np.arange(256)[:, None]  # grey levels of a screen
    seen[: 2 * SCREEN_RED, :, 3] = 255
    seen[0] = 0  # nothing was drawn
    return seen.view(np.uint32)[..., 0]


def _add_light(spec: Any, *, shadows: bool) -> None:
    """The light of `actors.backends.light`, as the sum of an even light and three directions."""
    even, slope = (light.SKY + light.GROUND) / 2, (light.SKY - light.GROUND) / 2
    spec.visual.headlight.active = 0
    # The even light is not the sun's: a shadow takes away all light of the source that casts it.
    for towards, diffuse, ambient in (
        (light.TO_SUN, light.SUN, 0.0),
        ((0.0, 0.0, 1.0), slope, even),
        ((0.0, 0.0, -1.0), -slope, 0.0),  # what faces down gets darker
    ):
        spec.worldbody.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=light.SHADOWS_CENTRE_M + light.SHADOWS_RADIUS_M * np.array(towards),
            dir=-np.array(towards),
            ambient=[ambient] * 3,
            diffuse=[diffuse] * 3,
            specular=[0.0] * 3,
            castshadow=shadows and towards == light.TO_SUN,
        )
    spec.visual.quality.shadowsize = light.SHADOW_MAP_SIZE if shadows else 0
    spec.visual.map.shadowclip = light.SHADOWS_RADIUS_M
    spec.stat.extent = 1.0  # the unit of `shadowclip`
