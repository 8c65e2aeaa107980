"""The neutral simulator interface: a scene and joint targets in, observations and truth out.

World frame (right-handed): x to the robot's right, y forward, z up. The origin lies on the table
top, straight below the origin of the robot's root link. The paper's task frame is left-handed:
x_world = -X_task, y_world = Y_task, z_world = Z_task, and a yaw changes its sign.

Nothing outside a backend's folder imports a simulator, and nothing is welded, attached or
teleported while a scene runs: what is lifted is lifted by friction.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from proto.config import SimulatorConfig
from proto.errors import UserError

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

EYE_WIDTH: Final = 320
EYE_HEIGHT: Final = 240
ROBOT: Final = "robot"
"""Name under which the robot stands in contact reports."""


@dataclass(frozen=True)
class Pose:
    """Pose of a body in the world frame.

    Attributes:
        position_m: (3,) x, y, z in metres.
        quaternion: (4,) unit quaternion, w first.
    """

    position_m: tuple[float, float, float]
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Bodies(Mapping[str, Pose]):
    """Poses of bodies by name.

    Attributes:
        places: row of each body in `rows`, in the order of the rows.
        rows: (B, 7) position (m) and unit quaternion (w first) of each body.
    """

    places: Mapping[str, int]
    rows: NDArray[np.floating]

    def __getitem__(self, name: str) -> Pose:
        x, y, z, qw, qx, qy, qz = self.rows[self.places[name]].tolist()
        return Pose((x, y, z), (qw, qx, qy, qz))

    def __iter__(self) -> Iterator[str]:
        return iter(self.places)

    def __len__(self) -> int:
        return len(self.places)


@dataclass(frozen=True)
class Box:
    """A box of the scene.

    Attributes:
        name: unique in the scene.
        size_m: full edge lengths along its own x, y, z (m).
        pose: where it starts.
        colour: red, green, blue in 0..1.
        mass_kg: mass, or None for a box that never moves.
        friction: Coulomb friction coefficient, static and dynamic.
        watched: report every touch of this box by the robot or a moving box.
    """

    name: str
    size_m: tuple[float, float, float]
    pose: Pose
    colour: tuple[float, float, float]
    mass_kg: float | None = None
    friction: float = 1.0
    watched: bool = False


@dataclass(frozen=True)
class JointTargets:
    """What the motors are told, in degrees.

    Attributes:
        neck_deg: (2,) pitch, yaw.
        arm_deg: (7,) right arm, shoulder pitch to wrist yaw.
        hand_deg: (9,) hand motors in the order of `sim_assets.hand.MOTORS`.
    """

    neck_deg: Array
    arm_deg: Array
    hand_deg: Array


@dataclass(frozen=True)
class Scene:
    """All that one episode starts from.

    Attributes:
        boxes: table, obstacle, objects.
        start: posture of the robot; it starts at rest there.
        table_drop_m: how far the table top lies below the robot's root link (m).
    """

    boxes: tuple[Box, ...]
    start: JointTargets
    table_drop_m: float


@dataclass(frozen=True)
class Crop:
    """Centre crop of the 320 x 240 eye image, in its pixels."""

    width: int = EYE_WIDTH
    height: int = EYE_HEIGHT


@dataclass(frozen=True)
class Observation:
    """What the robot senses at one instant.

    Attributes:
        image: (48, 64) uint8 grey picture of the crop asked for (V_I before normalization).
        joints_deg: (18,) measured angles: neck (2), arm (7), hand motors (9), in degrees.
        finger_contact: whether any finger touches a moving box.
    """

    image: Image
    joints_deg: Array
    finger_contact: bool


@dataclass(frozen=True)
class StepReport:
    """What happened during one control step, looked at in every physics step.

    Attributes:
        touches: (watched box, toucher) pairs; toucher is ROBOT or the name of a moving box.
    """

    touches: frozenset[tuple[str, str]]


class Simulator(Protocol):
    """A simulator that can play scenes; made once, reset for each episode.

    Attributes:
        name: what it is called in the config and in recordings.
        control_period_s: how long one control step lasts (s).
    """

    name: str
    control_period_s: float

    def reset(self, scene: Scene) -> None:
        """Replace whatever was there with `scene`; the same scene gives the same episode."""

    def step(self, targets: JointTargets) -> StepReport:
        """Run one control period, moving the motors' targets linearly to `targets`."""

    def observe(self, crop: Crop) -> Observation:
        """Look through the left eye and feel the joints, now."""

    def joints_deg(self) -> Array:
        """Measured joint angles (18,) in degrees, without rendering."""

    def bodies(self) -> Bodies:
        """True pose of every box and of every moving link of the robot, by name."""

    def show(self, joints_deg: Array, boxes: Mapping[str, Pose]) -> None:
        """Put a recorded state on the stage for pictures; not for use during an episode."""

    def eye_picture(self, crop: Crop, width: int, height: int) -> Image:
        """Colour picture (height, width, 3) uint8 of the left eye's crop."""

    def outside_picture(self, width: int, height: int) -> Image:
        """Colour picture (height, width, 3) uint8 of the scene from outside, full meshes."""

    def close(self) -> None:
        """Free what the simulator holds."""


BACKENDS: Final[Mapping[str, str]] = {"sapien": "actors.backends.sapien.simulator:SapienSimulator"}


def make_simulator(config: SimulatorConfig) -> Simulator:
    """Make the backend that `config.backend` names: one of BACKENDS or `package.module:Class`.

    Raises:
        UserError: there is no such backend, or it cannot run on this machine.
    """
    path = BACKENDS.get(config.backend, config.backend)
    module_name, separator, class_name = path.partition(":")
    if not separator:
        raise UserError(
            f"simulator.backend: there is no backend {config.backend!r}. There are: "
            f"{', '.join(sorted(BACKENDS))}; a backend of your own is named package.module:Class."
        )
    try:
        factory = getattr(importlib.import_module(module_name), class_name)
    except (ImportError, AttributeError) as error:
        raise UserError(
            f"simulator.backend: {config.backend!r} cannot be loaded ({error}). "
            f"Built in are: {', '.join(sorted(BACKENDS))}."
        ) from error
    simulator: Simulator = factory(config)
    return simulator
