"""The simulator interface: a scene and joint targets in, observations and true poses out.

World frame (right-handed): x to the robot's right, y forward, z up. The origin lies on the table
top, straight below the origin of the robot's root link. The paper's task frame is left-handed:
x_world = -X_task, y_world = Y_task, z_world = Z_task, and a yaw changes its sign.

Only a backend's own folder imports its simulator. During an episode nothing is welded, attached or
teleported: what is lifted is lifted by friction. Only the outside hand of a disturbance (`Shove`)
moves a box otherwise.
"""

from __future__ import annotations

import importlib.util
import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from proto.config import SimulatorConfig
from proto.disturbances import Ability
from proto.errors import UserError
from proto.extensions import load_class
from proto.suites import Player

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

EYE_WIDTH: Final = 320
EYE_HEIGHT: Final = 240
DARK_SCREEN: Final = 20
"""Grey level of a screen that shows nothing."""
ROBOT: Final = "robot"
"""Name of the robot in contact reports."""


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
    """Target angles of all motors, in degrees.

    Attributes:
        neck_deg: (2,) pitch, yaw.
        arm_deg: (7,) right arm, shoulder pitch to wrist yaw.
        hand_deg: (9,) hand motors in the order of `sim_assets.hand.MOTORS`.
    """

    neck_deg: Array
    arm_deg: Array
    hand_deg: Array


@dataclass(frozen=True, eq=False)
class Screen:
    """A flat screen that shows one grey frame in each control step. Nothing can touch it.

    A screen glows: the picture shows its grey levels as they are, whatever the light.

    Attributes:
        size_m: width and height.
        pose: of its centre; unturned, it stands upright and faces -y, towards the robot, with the
            left edge of its frames at -x.
        frames: (N, height, width) uint8; frame t is shown while the robot observes at control step
            t, counted from 0. After the last frame the screen is dark.
    """

    size_m: tuple[float, float]
    pose: Pose
    frames: Image

    def frame(self, step: int) -> Image:
        """What the screen shows at a control step: (height, width) uint8."""
        if step < len(self.frames):
            return np.asarray(self.frames[step], dtype=np.uint8)
        return np.full(self.frames.shape[1:], DARK_SCREEN, dtype=np.uint8)


@dataclass(frozen=True)
class Shove:
    """An outside hand moves a box during one control step, in a straight line and evenly.

    In each of the n physics steps of the control step the box's pose changes by 1/n of the shove,
    from wherever the box is; then its velocity is zero.

    Attributes:
        box: name of a box that can move.
        step: the control step, counted from 0.
        shift_m: movement along x and y of the world frame.
        turn_deg: turn about the vertical through the box's centre, counter-clockwise from above.
    """

    box: str
    step: int
    shift_m: tuple[float, float]
    turn_deg: float

    def moved(self, pose: Pose, share: float) -> Pose:
        """The pose of the box after a share 0..1 of the shove."""
        x, y, z = pose.position_m
        w, i, j, k = pose.quaternion
        half = math.radians(share * self.turn_deg) / 2
        cos, sin = math.cos(half), math.sin(half)
        return Pose(
            (x + share * self.shift_m[0], y + share * self.shift_m[1], z),
            (cos * w - sin * k, cos * i - sin * j, cos * j + sin * i, cos * k + sin * w),
        )


@dataclass(frozen=True)
class Knock:
    """An outside torque acts on a joint, besides that of its drive.

    Attributes:
        joint: name of the joint.
        torque_nm: the torque in the direction of the joint's positive angles (Nm).
        step: first control step, counted from 0.
        steps: number of control steps.
    """

    joint: str
    torque_nm: float
    step: int
    steps: int


UNTURNED: Final = (1.0, 0.0, 0.0, 0.0)
"""The quaternion (w first) that turns nothing."""


@dataclass(frozen=True)
class Scene:
    """The initial state of an episode, and what happens to it from outside.

    The last four attributes are disturbances. A simulator can play those that its `abilities` name;
    it is not given others.

    Attributes:
        boxes: table, obstacle, objects.
        start: posture in which the robot starts, at rest.
        table_drop_m: how far the table top lies below the robot's root link (m).
        screen: a screen, if there is one.
        shoves: boxes that an outside hand moves.
        knocks: outside torques on joints.
        damping: by joint, the factor of the damping of its drive (`actors.backends.robot.Drive`).
        eye_turn: unit quaternion (w first) by which the eye's camera is turned in the frame of the
            eye's link: x along the optical axis, y to the left, z up.
    """

    boxes: tuple[Box, ...]
    start: JointTargets
    table_drop_m: float
    screen: Screen | None = None
    shoves: tuple[Shove, ...] = ()
    knocks: tuple[Knock, ...] = ()
    damping: Mapping[str, float] = field(default_factory=dict)
    eye_turn: tuple[float, float, float, float] = UNTURNED

    def shoves_at(self, step: int) -> list[Shove]:
        """The shoves of a control step."""
        return [shove for shove in self.shoves if shove.step == step]

    def torques_nm(self, step: int) -> dict[str, float]:
        """The outside torques of a control step, by joint."""
        return {
            knock.joint: knock.torque_nm
            for knock in self.knocks
            if knock.step <= step < knock.step + knock.steps
        }


@dataclass(frozen=True)
class Crop:
    """Centre crop of the 320 x 240 eye image, in its pixels."""

    width: int = EYE_WIDTH
    height: int = EYE_HEIGHT


@dataclass(frozen=True)
class Observation:
    """What the robot senses at one instant.

    Attributes:
        image: (48, 64) uint8 grey picture of the requested crop (V_I before normalization).
        joints_deg: (18,) measured angles: neck (2), arm (7), hand motors (9), in degrees.
    """

    image: Image
    joints_deg: Array


@dataclass(frozen=True)
class StepReport:
    """What happened during one control step, collected from all of its physics steps.

    Attributes:
        touches: (watched box, toucher) pairs of bodies that overlap, or that are so near and so
            fast that they would overlap within a physics step; toucher is ROBOT or the name of a
            moving box.
    """

    touches: frozenset[tuple[str, str]]


OTHER_SYSTEM: Final = "other"
"""Key in `Diagnosis.packages` for all systems that have no key of their own."""


@dataclass(frozen=True)
class Diagnosis:
    """Whether a backend can render on this machine.

    Attributes:
        works: whether it can.
        found: one line that names what renders, or says what is wrong.
        cure: what the user can do about it, in a few lines; empty if it works.
        packages: arguments of `apt-get install` that provide the graphics driver, by system, such
            as "debian-12" or "ubuntu-24.04" (ID and VERSION_ID of /etc/os-release), and for
            OTHER_SYSTEM. Empty if it works, or if no package helps.
    """

    works: bool
    found: str
    cure: str = ""
    packages: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def text(self) -> str:
        """What was found and, if it does not work, what to do."""
        return self.found if self.works else f"{self.found}.\n{self.cure}".rstrip()

    def packages_for(self, system: str) -> tuple[str, ...]:
        """The arguments of `apt-get install` for a system; empty where none are known."""
        return self.packages.get(system, self.packages.get(OTHER_SYSTEM, ()))


class Simulator(Protocol):
    """A simulator that can play scenes; made once from a `SimulatorConfig`, reset for each episode.

    With `SimulatorConfig.render` false it must run without any graphics driver, and every observed
    image is black.

    Attributes:
        name: the backend's name in the config and in recordings; `make_simulator` sets it.
        control_period_s: duration of one control step.
        abilities: which disturbances of a `Scene` it can play.
    """

    name: str
    control_period_s: float
    abilities: ClassVar[frozenset[Ability]] = frozenset()

    @abstractmethod
    def __init__(self, config: SimulatorConfig) -> None:
        """Make the simulator.

        Raises:
            UserError: it cannot run on this machine; the message says what to do.
        """

    @staticmethod
    @abstractmethod
    def diagnose() -> Diagnosis:
        """Try to render on this machine; returns even if a graphics driver crashes."""

    @abstractmethod
    def reset(self, scene: Scene) -> None:
        """Replace the previous scene by `scene`; the same scene gives the same episode.

        Raises:
            UserError: it cannot show what the scene has, such as a screen.
        """

    @abstractmethod
    def step(self, targets: JointTargets) -> StepReport:
        """Run one control period, moving the motors' targets linearly to `targets`.

        Raises:
            ValueError: a target is not a finite number.
        """

    @abstractmethod
    def observe(self, crop: Crop) -> Observation:
        """The network's picture of the left eye's crop, and the measured joints, now."""

    @abstractmethod
    def joints_deg(self) -> Array:
        """Measured joint angles (18,) in degrees, without rendering."""

    @abstractmethod
    def bodies(self) -> Bodies:
        """True pose of every box and of every moving link of the robot, by name."""

    @abstractmethod
    def show(self, joints_deg: Array, bodies: Mapping[str, Pose], step: int) -> None:
        """Put robot, boxes and screen into a recorded state, for pictures; not during an episode.

        Args:
            joints_deg: (18,) joint angles, as `joints_deg` measures them.
            bodies: poses of boxes and links by name; boxes that are not among them stay where they
                are. With the links of the fingers, these are shown as they were.
            step: control step of the recorded state, which the screen shows.
        """

    @abstractmethod
    def eye_picture(self, crop: Crop, width: int, height: int) -> Image:
        """Colour picture (height, width, 3) uint8 of the left eye's crop."""

    @abstractmethod
    def outside_picture(self, width: int, height: int) -> Image:
        """Colour picture (height, width, 3) uint8 of the scene from outside, full meshes."""

    @abstractmethod
    def close(self) -> None:
        """Free what the simulator holds."""


BACKENDS: Final[Mapping[str, str]] = {
    "mujoco": "actors.backends.mujoco.simulator:MujocoSimulator",
    "sapien": "actors.backends.sapien.simulator:SapienSimulator",
}
"""The class of each built-in backend; a backend is called as the Python package that it needs."""


def is_installed(backend: str) -> bool:
    """Whether the Python package that a built-in backend needs is installed."""
    return importlib.util.find_spec(backend) is not None


def installed_backends() -> tuple[str, ...]:
    """Names of the built-in backends whose Python package is installed."""
    return tuple(name for name in BACKENDS if is_installed(name))


def player_of(simulator: Simulator) -> Player:
    """What can be played with a simulator."""
    return Player(simulator.name, tuple(sorted(abilities_of(simulator))))


def abilities_of(simulator: Simulator) -> frozenset[Ability]:
    """Which disturbances a simulator can play; none if its class does not say."""
    return frozenset(getattr(simulator, "abilities", ()))


def load_backend(name: str) -> type[Simulator]:
    """The class of the backend with a name: one of BACKENDS, or `package.module:Class`.

    Raises:
        UserError: there is no such backend, its package is not installed, or it lacks methods of
            `Simulator`.
    """
    if name in BACKENDS and not is_installed(name):
        raise UserError(
            f"simulator.backend: {name!r} needs a package that is not installed: pip install"
            f" 'vmdnn[{name}]'; in a checkout, deploy/run_local.sh --backend {name} installs it."
            f" Installed are: {', '.join(installed_backends())}."
        )
    return load_class("simulator.backend", name, BACKENDS, Simulator.__abstractmethods__)


def make_simulator(config: SimulatorConfig) -> Simulator:
    """Make the backend that `config.backend` names, and give it that name.

    Raises:
        UserError: there is no such backend, or it cannot run on this machine.
    """
    simulator = load_backend(config.backend)(config)
    simulator.name = config.backend
    return simulator
