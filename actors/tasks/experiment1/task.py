"""Experiment I of the paper (section 4.2): reach over an obstacle, grasp a box, lift it.

Task frame of the paper: X lateral (negative is the robot's right), Y forward, Z up, left-handed.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from actors.attention import targets_of_action
from actors.simulator import Box, Pose, Scene, StepReport
from actors.tasks.contract import Situation
from proto.config import Attention
from proto.episode import Outcome, Reason
from proto.errors import UserError
from sim_assets.hand import GRASP_AXIS, GRASP_CENTRE_M, closing_fraction
from sim_assets.icub import HAND

Array = NDArray[np.float64]

OBSTACLE_X_M: Final = (-0.22, -0.27, -0.32)
OBJECT_Y_M: Final = (0.20, 0.25, 0.30)
OBJECT_YAW_DEG: Final = (-45.0, -22.5, 0.0, 22.5, 45.0)
GRID: Final[Mapping[str, tuple[float, ...]]] = {
    "obstacle_x_m": OBSTACLE_X_M,
    "object_y_m": OBJECT_Y_M,
    "object_yaw_deg": OBJECT_YAW_DEG,
}
"""What is tutored of each value of a situation; the tested ranges are what these span."""

# Sizes are the paper's. The object's X, the obstacle's Y and the height of the table it leaves
# open; here they are where the arm reaches every corner of the ranges.
OBJECT_SIZE_M: Final = (0.028, 0.10, 0.07)
OBJECT_X_M: Final = -0.04
OBJECT_MASS_KG: Final = 0.1
OBSTACLE_SIZE_M: Final = (0.01, 0.26, 0.20)
OBSTACLE_Y_M: Final = 0.30
TABLE_SIZE_M: Final = (0.90, 0.44, 0.04)
TABLE_CENTRE_M: Final = (0.05, 0.31)
TABLE_DROP_M: Final = 0.15
FRICTION: Final = 1.0

SUBTASKS: Final[Mapping[str, int]] = {
    "observe": 8,
    "attend obstacle": 10,
    "move over obstacle": 22,
    "attend object": 10,
    "reach above object": 20,
    "descend": 20,
    "grasp": 14,
    "lift": 20,
}
"""The eight subtasks of the paper and the control steps that each takes."""

START: Final = np.array([-32.0, -23.0, -3.0, 54.0, -22.0, 18.0, -32.0, -9.0, 10.0, 1.0, 1.0])
"""Posture and levels that every episode starts from (see `proto.body`)."""

LIFTED_M: Final = 0.05
HELD_STEPS: Final = 5
MOVED_MM: Final = 10.0
TURNED_DEG: Final = 5.0
CLOSED_FRACTION: Final = 0.15
YAW_ERROR_DEG: Final = 10.0
ALONG_MM: Final = 20.0
ACROSS_MM: Final = 10.0


def object_pose(situation: Situation) -> Pose:
    """Where the object starts, in the world frame."""
    half_turn = np.deg2rad(-situation["object_yaw_deg"]) / 2
    return Pose(
        (-OBJECT_X_M, situation["object_y_m"], OBJECT_SIZE_M[2] / 2),
        (float(np.cos(half_turn)), 0.0, 0.0, float(np.sin(half_turn))),
    )


def obstacle_pose(situation: Situation) -> Pose:
    """Where the obstacle stands, in the world frame."""
    return Pose((-situation["obstacle_x_m"], OBSTACLE_Y_M, OBSTACLE_SIZE_M[2] / 2))


class Experiment1:
    """The task; see the module's docstring.

    Attributes:
        grid: the tutored values of what makes a situation, by name.
        attention: whether the head turns and the eye focuses.
    """

    name = "experiment1"
    grid: ClassVar[Mapping[str, tuple[float, ...]]] = GRID
    phases = np.repeat(np.arange(1, 9, dtype=np.uint8), list(SUBTASKS.values()))
    start = START

    def __init__(self, attention: Attention = "active") -> None:
        self.attention = attention

    def tutored(self) -> tuple[Situation, ...]:
        """The cases of the grid; the paper's 45."""
        return self._situations(itertools.product(*self.grid.values()))

    def sample(self, seed: int) -> Situation:
        """An unlearned situation, uniform inside the ranges; the same seed gives the same."""
        random = np.random.default_rng(seed)
        return {name: float(random.uniform(*limits)) for name, limits in self.ranges().items()}

    def corners(self) -> tuple[Situation, ...]:
        """The corners of the ranges."""
        return self._situations(itertools.product(*self.ranges().values()))

    def check(self, situation: Situation) -> None:
        """Raise UserError unless the situation has this task's values within its ranges."""
        if set(situation) != set(self.grid):
            wanted, given = ", ".join(self.grid), ", ".join(situation)
            raise UserError(f"{self.name}: a situation has {wanted}; this one has {given}")
        for name, (low, high) in self.ranges().items():
            if not low - 1e-9 <= situation[name] <= high + 1e-9:
                raise UserError(
                    f"{self.name}: {name} = {situation[name]} lies outside {low} .. {high}"
                )

    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """Smallest and largest of each value."""
        return {name: (min(values), max(values)) for name, values in self.grid.items()}

    def scene(self, situation: Situation) -> Scene:
        """Table, obstacle if there is one, and object."""
        return Scene(
            boxes=(_table(), *_obstacles(situation), _object(situation)),
            start=targets_of_action(START),
            table_drop_m=TABLE_DROP_M,
        )

    def judge(self, situation: Situation) -> Experiment1Judge:
        """A judge for one episode of the situation."""
        return Experiment1Judge(situation)

    def _situations(self, rows: Iterable[tuple[float, ...]]) -> tuple[Situation, ...]:
        return tuple(dict(zip(self.grid, row, strict=True)) for row in rows)


def _table() -> Box:
    place = Pose((*TABLE_CENTRE_M, -TABLE_SIZE_M[2] / 2))
    return Box("table", TABLE_SIZE_M, place, (0.75, 0.72, 0.65), friction=FRICTION)


def _obstacles(situation: Situation) -> tuple[Box, ...]:
    if "obstacle_x_m" not in situation:
        return ()
    place, colour = obstacle_pose(situation), (0.9, 0.8, 0.1)
    return (Box("obstacle", OBSTACLE_SIZE_M, place, colour, friction=FRICTION, watched=True),)


def _object(situation: Situation) -> Box:
    return Box(
        "object",
        OBJECT_SIZE_M,
        object_pose(situation),
        (0.8, 0.1, 0.1),
        mass_kg=OBJECT_MASS_KG,
        friction=FRICTION,
    )


@dataclass(frozen=True)
class _Instant:
    """What the judge keeps of one control step; what follows from it is worked out at the end."""

    joints_deg: Array
    touched: bool
    bodies: Mapping[str, Pose]

    @property
    def closing(self) -> float:
        return closing_fraction(self.joints_deg[9:])


@dataclass(frozen=True)
class _Approach:
    """How the hand came to the object."""

    moved_mm: float
    turned_deg: float
    yaw_error_deg: float
    along_mm: float
    across_mm: float


class Experiment1Judge:
    """Reads the three readings of success from true poses and the measured hand."""

    def __init__(self, situation: Situation) -> None:
        """Start watching an episode of `situation`."""
        self._start = object_pose(situation)
        self._instants: list[_Instant] = []

    def watch(self, report: StepReport, joints_deg: Array, bodies: Mapping[str, Pose]) -> None:
        """Take note of one control step that has just been run."""
        touched = any(box == "obstacle" for box, _ in report.touches)
        self._instants.append(_Instant(joints_deg, touched, bodies))

    def outcome(self) -> Outcome:
        """How the episode went, once its last step was watched."""
        instants = self._instants
        closed_at = self._closed_at()
        # The last instant at which the hand was still open tells how it came to the object.
        before = self._approach(instants[max(closed_at - 1, 0)] if closed_at >= 0 else instants[-1])
        touched_at = next((k for k, instant in enumerate(instants) if instant.touched), -1)
        lifted_m = [self._lifted_m(instant) for instant in instants[-HELD_STEPS:]]
        lenient = lifted_m[-1] > LIFTED_M
        held = min(lifted_m) > LIFTED_M
        unmoved = before.moved_mm <= MOVED_MM and before.turned_deg <= TURNED_DEG
        strict = held and unmoved and closed_at >= 0 and touched_at < 0
        right = (
            abs(before.yaw_error_deg) <= YAW_ERROR_DEG
            and abs(before.along_mm) <= ALONG_MM
            and abs(before.across_mm) <= ACROSS_MM
        )
        failures = (
            (touched_at >= 0, Reason.TOUCHED_OBSTACLE),
            (not unmoved, Reason.MOVED_OBJECT),
            (closed_at < 0, Reason.NEVER_CLOSED),
            (not held, Reason.NOT_LIFTED),
            (not right, Reason.IMPRECISE),
        )
        return Outcome(
            lenient=lenient,
            strict=strict,
            precise=strict and right,
            reason=next((reason for failed, reason in failures if failed), Reason.NONE),
            lifted_m=lifted_m[-1],
            moved_mm=before.moved_mm,
            turned_deg=before.turned_deg,
            yaw_error_deg=before.yaw_error_deg,
            along_mm=before.along_mm,
            across_mm=before.across_mm,
            closed_at=closed_at,
            obstacle_touched_at=touched_at,
        )

    def _lifted_m(self, instant: _Instant) -> float:
        return instant.bodies["object"].position_m[2] - self._start.position_m[2]

    def _approach(self, instant: _Instant) -> _Approach:
        body = instant.bodies["object"]
        moved = np.subtract(body.position_m, self._start.position_m)
        yaw = _yaw_deg(body)
        axis, grasp_centre = _grasp(instant.bodies[HAND])
        hand_yaw = float(np.rad2deg(np.arctan2(axis[1], axis[0])))
        centre = grasp_centre - body.position_m
        turn = np.deg2rad(yaw)
        return _Approach(
            moved_mm=1e3 * float(np.hypot(moved[0], moved[1])),
            turned_deg=float(abs(_half_turn(yaw - _yaw_deg(self._start)))),
            yaw_error_deg=_half_turn(yaw - hand_yaw),  # the task frame's yaw turns the other way
            along_mm=1e3 * float(-centre[0] * np.sin(turn) + centre[1] * np.cos(turn)),
            across_mm=1e3 * float(centre[0] * np.cos(turn) + centre[1] * np.sin(turn)),
        )

    def _closed_at(self) -> int:
        """First step from which the hand stays closed to the end, or -1."""
        closed_at = -1
        for k, instant in enumerate(self._instants):
            if instant.closing < CLOSED_FRACTION:
                closed_at = -1
            elif closed_at < 0:
                closed_at = k
        return closed_at


def _grasp(hand: Pose) -> tuple[Array, Array]:
    """Grasp axis (unit, from the thumb to the fingers) and grasp centre in the world frame."""
    w, x, y, z = hand.quaternion
    turn = Rotation.from_quat((x, y, z, w))
    return turn.apply(GRASP_AXIS), hand.position_m + turn.apply(GRASP_CENTRE_M)


def _yaw_deg(pose: Pose) -> float:
    w, x, y, z = pose.quaternion
    return float(np.rad2deg(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))


def _half_turn(angle_deg: float) -> float:
    """The angle folded into -90..90 degrees: a box looks the same after half a turn."""
    return (angle_deg + 90.0) % 180.0 - 90.0
