"""What the built-in simulators have in common: motors, eye, and when what is measured.

A built-in simulator has a world, which does the physics, and renderers, which draw copies of its
bodies. It says how these are made.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from actors.backends import eye
from actors.backends.furniture import furnished
from actors.backends.robot import (
    MOTOR_COUNT,
    build_robot,
    joints_from_motors_rad,
    motor_ramp_deg,
    motors_from_joints_deg,
    motors_of,
    recorded_joints_rad,
)
from actors.simulator import (
    Array,
    Bodies,
    Crop,
    Image,
    JointTargets,
    Observation,
    Pose,
    Scene,
    Shove,
    StepReport,
)
from proto.config import SimulatorConfig
from sim_assets.built_visuals import Visual


class World(Protocol):
    """The robot and the boxes of one scene, with their physics."""

    def drive(self, targets_rad: Array) -> None:
        """Set the targets (J,) of the joints' drives."""

    def push_joints(self, torques_nm: Mapping[str, float]) -> None:
        """Push joints from outside, until the next call."""

    def shove(self, shove: Shove, share: float) -> None:
        """Move a box from outside by a share of the whole way."""

    def step(self) -> None:
        """Run one period of the physics."""

    def touches(self) -> Iterable[tuple[str, str]]:
        """(watched box, toucher) pairs of bodies that touch now."""

    def joints_rad(self) -> Array:
        """Measured joint angles (J,)."""

    def put(self, joints_rad: Array, boxes: Mapping[str, Pose]) -> None:
        """Put the robot, at rest, and some of the boxes where they are told to be."""

    def poses(self) -> Any:
        """Poses of all links and boxes, by name, as the renderer takes them."""

    def bodies(self) -> Bodies:
        """Poses of all links that can move and of all boxes, by name."""


class Renderer(Protocol):
    """Draws copies of a world's bodies."""

    def set_scene(self, scene: Scene) -> None:
        """Replace what was drawn beside the robot."""

    def place(self, poses: Any, step: int) -> None:
        """Move the copies to `World.poses`, and show the screen's frame of a control step.

        Boxes that are not in the world stay where the scene puts them.
        """

    def picture(self, place: Any, /, width: int, height: int, focal: tuple[float, float]) -> Image:
        """Picture (height, width, 4) from a place with the focal lengths (pixels)."""


W = TypeVar("W", bound=World)
R = TypeVar("R", bound=Renderer)


class BaseSimulator(ABC, Generic[W, R]):
    """Plays scenes; see `actors.simulator.Simulator`.

    With `config.render` false no graphics driver is loaded and every observed image is black.
    """

    def __init__(self, config: SimulatorConfig) -> None:
        """Make the simulator.

        Raises:
            UserError: pictures are wanted, but this machine cannot render; or the robot's model
                cannot be built. The message says what to do.
        """
        self.control_period_s = config.control_period_s
        if config.render:
            self._require_graphics()
        self._config = config
        self._model = build_robot()
        self._eye_renderer: R | None = None
        self._outside_renderer: R | None = None
        self._current_scene: Scene | None = None
        self._current_world: W | None = None
        self._targets_deg = np.zeros(MOTOR_COUNT)
        self._step = 0
        # Measured once a step at most: players ask before and after each step.
        self._joints_deg: Array | None = None
        self._bodies: Bodies | None = None

    @abstractmethod
    def _require_graphics(self) -> None:
        """Raise UserError if this machine cannot render."""

    @abstractmethod
    def _make_world(self, scene: Scene, start_rad: Array) -> W:
        """Make the world of a scene, with the robot's joints (J,) at their start."""

    @abstractmethod
    def _make_renderer(self, robot: tuple[Visual, ...], scene: Scene, *, shadows: bool) -> R:
        """Make a renderer of the robot, in some of its meshes, and of a scene."""

    @abstractmethod
    def _eye_place(self, poses: Any, scene: Scene) -> Any:
        """The eye's place as the renderer takes it: from `World.poses`, turned by the scene."""

    @abstractmethod
    def _outside_place(self) -> Any:
        """The outside camera's place as the renderer takes it."""

    def _renewed(self, renderer: R, scene: Scene) -> R | None:
        """The renderer with a new scene; None if it has to be made anew."""
        renderer.set_scene(scene)
        return renderer

    def reset(self, scene: Scene) -> None:
        """Replace the previous scene by `scene`; the same scene gives the same episode."""
        self._current_scene = scene
        self._step = 0
        self._targets_deg = motors_of(scene.start)
        self._current_world = self._make_world(scene, joints_from_motors_rad(self._targets_deg))
        self._forget()
        if self._eye_renderer is not None:
            self._eye_renderer = self._renewed(self._eye_renderer, scene)
        if self._outside_renderer is not None:
            self._outside_renderer = self._renewed(self._outside_renderer, furnished(scene))

    def step(self, targets: JointTargets) -> StepReport:
        """Run one control period, moving the motors' targets linearly to `targets`.

        Raises:
            ValueError: a target is not a finite number.
        """
        before, after = self._targets_deg, motors_of(targets)
        if not np.isfinite(after).all():
            raise ValueError(f"joint targets must be finite, got {after}")
        ramp_deg = motor_ramp_deg(before, after, self._config.substeps)
        world = self._world
        if self._scene.knocks:
            world.push_joints(self._scene.torques_nm(self._step))
        shoves = self._scene.shoves_at(self._step)
        touches: set[tuple[str, str]] = set()
        for joints_rad in joints_from_motors_rad(ramp_deg):
            world.drive(joints_rad)
            for shove in shoves:
                world.shove(shove, 1 / self._config.substeps)
            world.step()
            touches.update(world.touches())
        self._targets_deg = after
        self._step += 1
        self._forget()
        return StepReport(frozenset(touches))

    def observe(self, crop: Crop) -> Observation:
        """The network's picture of the left eye's crop, and the measured joints, now."""
        if self._config.render:
            image = eye.grey(self._look(crop, *eye.SUPERSAMPLED_SIZE))
        else:
            image = eye.black()
        return Observation(image, self.joints_deg())

    def joints_deg(self) -> Array:
        """Measured joint angles (18,) in degrees, without rendering."""
        if self._joints_deg is None:
            self._joints_deg = motors_from_joints_deg(self._world.joints_rad())
        return self._joints_deg.copy()

    def bodies(self) -> Bodies:
        """True pose of every box and of every moving link of the robot, by name."""
        if self._bodies is None:
            self._bodies = self._world.bodies()
        return self._bodies

    def show(self, joints_deg: Array, bodies: Mapping[str, Pose], step: int) -> None:
        """Put robot, boxes and screen into a recorded state, for pictures; not during an episode.

        Args:
            joints_deg: (18,) joint angles, as `joints_deg` measures them.
            bodies: poses of boxes and links by name; boxes that are not among them stay where they
                are. With the links of the fingers, these are shown as they were.
            step: control step of the recorded state, which the screen shows.
        """
        boxes = {box.name: bodies[box.name] for box in self._scene.boxes if box.name in bodies}
        self._world.put(recorded_joints_rad(joints_deg, bodies), boxes)
        self._step = step
        self._forget()

    def eye_picture(self, crop: Crop, width: int, height: int) -> Image:
        """Colour picture (height, width, 3) uint8 of the left eye's crop."""
        return eye.colours(self._look(crop, width, height))

    def outside_picture(self, width: int, height: int) -> Image:
        """Colour picture (height, width, 3) uint8 from outside: full meshes, with shadows."""
        if self._outside_renderer is None:
            robot = self._model.seen_from_outside
            self._outside_renderer = self._make_renderer(
                robot, furnished(self._scene), shadows=True
            )
        self._outside_renderer.place(self._world.poses(), self._step)
        factor = eye.OUTSIDE_SUPERSAMPLING
        focal = eye.outside_focal_lengths(factor * height)
        fine = self._outside_renderer.picture(
            self._outside_place(), factor * width, factor * height, focal
        )
        return eye.colours(eye.averaged(fine, factor))

    def close(self) -> None:
        """Free what the simulator holds."""
        self._current_world = self._eye_renderer = self._outside_renderer = None

    @property
    def _world(self) -> W:
        if self._current_world is None:
            raise RuntimeError("call reset(scene) first")
        return self._current_world

    @property
    def _scene(self) -> Scene:
        if self._current_scene is None:
            raise RuntimeError("call reset(scene) first")
        return self._current_scene

    def _forget(self) -> None:
        """Discard what was measured: the robot or a box may have moved."""
        self._joints_deg = self._bodies = None

    def _look(self, crop: Crop, width: int, height: int) -> Image:
        """Rendered picture (height, width, 4) of the left eye's crop; see `actors.backends.eye`."""
        if self._eye_renderer is None:
            self._eye_renderer = self._make_renderer(
                self._model.seen_by_eye, self._scene, shadows=False
            )
        poses = self._world.poses()
        self._eye_renderer.place(poses, self._step)
        focal = eye.eye_focal_lengths(crop, width, height)
        place = self._eye_place(poses, self._scene)
        return self._eye_renderer.picture(place, width, height, focal)
