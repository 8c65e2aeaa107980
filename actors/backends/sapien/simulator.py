"""The SAPIEN backend of `actors.simulator.Simulator`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import cv2
import numpy as np

from actors.backends.sapien.graphics import require_graphics
from actors.backends.sapien.stage import Picture, Stage, looking_at
from actors.backends.sapien.world import RobotBuilder, World
from actors.simulator import (
    EYE_HEIGHT,
    Array,
    Bodies,
    Crop,
    Image,
    JointTargets,
    Observation,
    Pose,
    Scene,
    StepReport,
)
from proto.body import IMAGE_HEIGHT, IMAGE_WIDTH
from proto.config import SimulatorConfig
from proto.errors import UserError
from sim_assets.hand import joints_from_motors, motors_from_joints
from sim_assets.icub import EYE, IcubModel, build_icub
from sim_assets.icub_visuals import Visual


def _focal(fov_deg: float, pixels: int) -> float:
    """Focal length in pixels of a camera that sees so much across so many pixels."""
    return pixels / 2 / math.tan(math.radians(fov_deg / 2))


EYE_FOV_DEG: Final = 50.0
"""Vertical field of view of the whole eye image."""
_EYE_FOCAL: Final = _focal(EYE_FOV_DEG, EYE_HEIGHT)
SUPERSAMPLING: Final = 3
"""Rendered pixels along each side of one pixel of the network's picture."""
OUTSIDE_POSE: Final = looking_at((-0.7, 1.0, 0.55), (0.09, 0.12, 0.11))
"""From the robot's left front, a little above it (world frame, m)."""
OUTSIDE_FOV_DEG: Final = 52.0
OUTSIDE_SUPERSAMPLING: Final = 2
SKY: Final = 102.0
"""Grey of what lies beyond all bodies: lighter than the hand, darker than the table."""
# Rec. 601 luma of red, green and blue; sky where the fourth value of `Stage.picture` is 0
_GREY: Final = np.array([0.299, 0.587, 0.114, -SKY / 255.0], dtype=np.float32)


class SapienSimulator:
    """Plays scenes in SAPIEN; see `actors.simulator.Simulator`.

    With `config.render` false nothing graphical is touched and every observed image is black.

    Raises:
        UserError: pictures are wanted, but this machine cannot render; or the robot's model cannot
            be built. The message says what to do.
    """

    name = "sapien"

    def __init__(self, config: SimulatorConfig) -> None:
        self.control_period_s = config.control_period_s
        if config.render:
            require_graphics()
        self._config = config
        self._model = _built_robot()
        self._builder = RobotBuilder(self._model)
        self._eye_stage: Stage | None = None
        self._outside_stage: Stage | None = None
        self._scene: Scene | None = None
        self._world_now: World | None = None
        self._targets_deg = np.zeros(18)
        # Players ask for these before and after each step.
        self._joints_deg: Array | None = None
        self._bodies: Bodies | None = None

    def reset(self, scene: Scene) -> None:
        """Replace whatever was there with `scene`; the same scene gives the same episode."""
        self._scene = scene
        self._targets_deg = _values(scene.start)
        self._world_now = World(
            self._builder,
            self._model.joints,
            scene,
            _angles_rad(self._targets_deg),
            self._config.physics_period_s,
        )
        self._forget()
        for stage in (self._eye_stage, self._outside_stage):
            if stage is not None:
                stage.set_boxes(scene.boxes)

    def step(self, targets: JointTargets) -> StepReport:
        """Run one control period, moving the motors' targets linearly to `targets`.

        Raises:
            ValueError: a target is not a number.
        """
        before, after = self._targets_deg, _values(targets)
        if not np.isfinite(after).all():
            raise ValueError(f"joint targets must be finite, got {after}")
        substeps = self._config.substeps
        ramp = _angles_rad(np.linspace(before, after, substeps + 1)[1:])
        world = self._world
        touches: set[tuple[str, str]] = set()
        for angles_rad in ramp:
            world.drive(angles_rad)
            world.step()
            touches.update(world.touches())
        self._targets_deg = after
        self._forget()
        return StepReport(frozenset(touches))

    def observe(self, crop: Crop) -> Observation:
        """Look through the left eye and feel the joints, now."""
        return Observation(
            image=self._grey(crop) if self._config.render else _black(),
            joints_deg=self.joints_deg(),
            finger_contact=self._world.finger_contact(),
        )

    def joints_deg(self) -> Array:
        """Measured joint angles (18,) in degrees, without rendering."""
        if self._joints_deg is None:
            angles = np.rad2deg(self._world.joints_rad())
            self._joints_deg = np.concatenate([angles[:9], motors_from_joints(angles[9:])])
        return self._joints_deg.copy()

    def bodies(self) -> Bodies:
        """True pose of every box and of every moving link of the robot, by name."""
        if self._bodies is None:
            self._bodies = self._world.bodies()
        return self._bodies

    def show(self, joints_deg: Array, boxes: Mapping[str, Pose]) -> None:
        """Put a recorded state on the stage for pictures; not for use during an episode."""
        self._world.put(_angles_rad(joints_deg), boxes)
        self._forget()

    def eye_picture(self, crop: Crop, width: int, height: int) -> Image:
        """Colour picture (height, width, 3) uint8 of the left eye's crop."""
        return _before_sky(self._look(crop, width, height))

    def outside_picture(self, width: int, height: int) -> Image:
        """Colour picture (height, width, 3) uint8 of the scene from outside, full meshes."""
        if self._outside_stage is None:
            self._outside_stage = self._make_stage(self._model.seen_from_outside)
        self._outside_stage.place(self._world.poses())
        size = (OUTSIDE_SUPERSAMPLING * width, OUTSIDE_SUPERSAMPLING * height)
        focal = _focal(OUTSIDE_FOV_DEG, size[1])
        fine = self._outside_stage.picture(OUTSIDE_POSE, *size, (focal, focal))
        return _before_sky(_averaged(fine, OUTSIDE_SUPERSAMPLING))

    def close(self) -> None:
        """Free what the simulator holds."""
        self._world_now = self._eye_stage = self._outside_stage = None

    @property
    def _world(self) -> World:
        if self._world_now is None:
            raise RuntimeError("reset(scene) must come before everything else")
        return self._world_now

    def _forget(self) -> None:
        """The robot or a box may have moved."""
        self._joints_deg = self._bodies = None

    def _grey(self, crop: Crop) -> Image:
        """What the eye sees in a crop, averaged to (48, 64) uint8."""
        size = (SUPERSAMPLING * IMAGE_WIDTH, SUPERSAMPLING * IMAGE_HEIGHT)
        picture = _averaged(self._look(crop, *size), SUPERSAMPLING)
        return np.asarray(np.rint(picture @ _GREY + SKY), dtype=np.uint8)

    def _look(self, crop: Crop, width: int, height: int) -> Picture:
        """What the eye sees in a crop, (height, width, 4) as in `Stage.picture`."""
        if self._eye_stage is None:
            self._eye_stage = self._make_stage(self._model.seen_by_eye)
        poses = self._world.poses()
        self._eye_stage.place(poses)
        focal = (_EYE_FOCAL * width / crop.width, _EYE_FOCAL * height / crop.height)
        return self._eye_stage.picture(poses[EYE], width, height, focal)

    def _make_stage(self, robot: tuple[Visual, ...]) -> Stage:
        stage = Stage(robot)
        if self._scene is not None:
            stage.set_boxes(self._scene.boxes)
        return stage


def _built_robot() -> IcubModel:
    try:
        return build_icub()
    except OSError as error:
        raise UserError(
            f"the robot's model cannot be built: {error}. Set VMDNN_CACHE to a folder that can be"
            " written; if a file of icub-models is missing, install that package again."
        ) from error


def _before_sky(picture: Picture) -> Image:
    """Colours (height, width, 3) of a picture (height, width, 4) of bodies alone."""
    sky = SKY * (1.0 - picture[..., 3:] / 255.0)
    return np.asarray(np.rint(picture[..., :3] + sky), dtype=np.uint8)


def _averaged(fine: Picture, factor: int) -> Picture:
    """Mean over blocks of factor x factor pixels."""
    size = (fine.shape[1] // factor, fine.shape[0] // factor)
    return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _black() -> Image:
    return np.zeros((IMAGE_HEIGHT, IMAGE_WIDTH), dtype=np.uint8)


def _values(targets: JointTargets) -> Array:
    """The eighteen motor angles in degrees, in the order of `Observation.joints_deg`."""
    return np.concatenate([targets.neck_deg, targets.arm_deg, targets.hand_deg])


def _angles_rad(motors_deg: Array) -> Array:
    """Angles (..., 28) of all joints for the motor angles (..., 18)."""
    hand_deg = joints_from_motors(motors_deg[..., 9:])
    joints_deg = np.concatenate([motors_deg[..., :9], hand_deg], axis=-1)
    return np.asarray(np.deg2rad(joints_deg), dtype=np.float64)
