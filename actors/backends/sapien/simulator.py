"""The SAPIEN backend of `actors.simulator.Simulator`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import sapien

from actors.backends import eye
from actors.backends.robot import (
    MOTOR_COUNT,
    build_robot,
    joints_from_motors_rad,
    motor_ramp_deg,
    motors_from_joints_deg,
    motors_of,
    recorded_joints_rad,
)
from actors.backends.sapien import graphics
from actors.backends.sapien.renderer import Renderer
from actors.backends.sapien.world import RobotBuilder, World
from actors.simulator import (
    UNTURNED,
    Array,
    Bodies,
    Crop,
    Diagnosis,
    Image,
    JointTargets,
    Observation,
    Pose,
    Scene,
    StepReport,
)
from proto.config import SimulatorConfig
from proto.disturbances import Ability
from sim_assets.icub import EYE
from sim_assets.icub_visuals import Visual


class SapienSimulator:
    """Plays scenes in SAPIEN; see `actors.simulator.Simulator`.

    With `config.render` false no graphics driver is loaded and every observed image is black.
    """

    name = "sapien"
    abilities = frozenset(Ability)

    def __init__(self, config: SimulatorConfig) -> None:
        """Make the simulator.

        Raises:
            UserError: pictures are wanted, but this machine cannot render; or the robot's model
                cannot be built. The message says what to do.
        """
        self.control_period_s = config.control_period_s
        if config.render:
            graphics.require_graphics()
        self._config = config
        self._model = build_robot()
        self._builder = RobotBuilder(self._model)
        self._eye_renderer: Renderer | None = None
        self._outside_renderer: Renderer | None = None
        self._current_scene: Scene | None = None
        self._current_world: World | None = None
        self._targets_deg = np.zeros(MOTOR_COUNT)
        self._step = 0
        # Measured once a step at most: players ask before and after each step.
        self._joints_deg: Array | None = None
        self._bodies: Bodies | None = None

    @staticmethod
    def diagnose() -> Diagnosis:
        """Try whether SAPIEN can render on this machine."""
        return graphics.diagnose()

    def reset(self, scene: Scene) -> None:
        """Replace the previous scene by `scene`; the same scene gives the same episode."""
        self._current_scene = scene
        self._step = 0
        self._targets_deg = motors_of(scene.start)
        self._current_world = World(
            self._builder,
            self._model.joints,
            scene,
            joints_from_motors_rad(self._targets_deg),
            self._config.physics_period_s,
        )
        self._forget()
        for renderer in (self._eye_renderer, self._outside_renderer):
            if renderer is not None:
                renderer.set_scene(scene)

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
        """Colour picture (height, width, 3) uint8 of the scene from outside, full meshes."""
        if self._outside_renderer is None:
            self._outside_renderer = self._make_renderer(self._model.seen_from_outside)
        self._outside_renderer.place(self._world.poses(), self._step)
        factor = eye.OUTSIDE_SUPERSAMPLING
        fine = self._outside_renderer.picture(
            sapien.Pose(eye.outside_pose()),
            factor * width,
            factor * height,
            eye.outside_focal_lengths(factor * height),
        )
        return eye.colours(eye.averaged(fine, factor))

    def close(self) -> None:
        """Free what the simulator holds."""
        self._current_world = self._eye_renderer = self._outside_renderer = None

    @property
    def _world(self) -> World:
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
            self._eye_renderer = self._make_renderer(self._model.seen_by_eye)
        poses = self._world.poses()
        self._eye_renderer.place(poses, self._step)
        focal = eye.eye_focal_lengths(crop, width, height)
        place = poses[EYE]
        if self._scene.eye_turn != UNTURNED:
            place = place * sapien.Pose(q=self._scene.eye_turn)
        return self._eye_renderer.picture(place, width, height, focal)

    def _make_renderer(self, robot: tuple[Visual, ...]) -> Renderer:
        renderer = Renderer(robot)
        renderer.set_scene(self._scene)
        return renderer
