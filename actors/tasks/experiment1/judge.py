"""Reads the three readings of success in Experiment I.

- lenient, the paper's: the object ends more than 5 cm above its start;
- strict: lifted and held, the obstacle never touched, the object moved by at most 10 mm and turned
  by at most 5 degrees before the hand closes;
- precise: strict, and the hand's pose to the object was right when it closed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from actors.simulator import Pose, StepReport
from actors.tasks.experiment1.world import object_pose
from proto.episode import NO_FAILURE, Measure, Outcome
from proto.variables import Situation
from sim_assets.hand import GRASP_AXIS, GRASP_CENTRE_M, closing_fraction
from sim_assets.icub import HAND

Array = NDArray[np.float64]

LIFTED_M: Final = 0.05
HELD_STEPS: Final = 5
MOVED_MM: Final = 10.0
TURNED_DEG: Final = 5.0
CLOSED_FRACTION: Final = 0.15
YAW_ERROR_DEG: Final = 10.0
ALONG_MM: Final = 20.0
ACROSS_MM: Final = 10.0

TOUCHED_OBSTACLE: Final = "touched_obstacle"
MOVED_OBJECT: Final = "moved_object"
NEVER_CLOSED: Final = "never_closed"
NOT_LIFTED: Final = "not_lifted"
IMPRECISE: Final = "imprecise"


@dataclass(frozen=True)
class _Instant:
    """The state after one control step."""

    joints_deg: Array
    touched: bool
    bodies: Mapping[str, Pose]

    @property
    def closing(self) -> float:
        return closing_fraction(self.joints_deg[9:])


@dataclass(frozen=True)
class _Approach:
    """How the hand came to the object.

    Attributes:
        moved_mm: how far the object had moved.
        turned_deg: how far the object had turned.
        yaw_error_deg: yaw of the hand's grasp axis less the object's, in the task frame, -90..90.
        along_mm: offset of the grasp centre along the object's long axis.
        across_mm: offset across it.
    """

    moved_mm: float
    turned_deg: float
    yaw_error_deg: float
    along_mm: float
    across_mm: float


class Experiment1Judge:
    """Judges one episode from true poses and the measured hand.

    Measures: `lifted_m`, height of the object above its start at the end; the attributes of
    `_Approach` at the last step before the hand closed; `closed_at`, the step at which it closed;
    `obstacle_touched_at`, the first step in which the obstacle was touched. A step that never came
    is -1.
    """

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
            (touched_at >= 0, TOUCHED_OBSTACLE),
            (not unmoved, MOVED_OBJECT),
            (closed_at < 0, NEVER_CLOSED),
            (not held, NOT_LIFTED),
            (not right, IMPRECISE),
        )
        return Outcome(
            lenient=lenient,
            strict=strict,
            precise=strict and right,
            reason=next((reason for failed, reason in failures if failed), NO_FAILURE),
            measures={
                "lifted_m": Measure(lifted_m[-1], "m"),
                "moved_mm": Measure(before.moved_mm, "mm"),
                "turned_deg": Measure(before.turned_deg, "deg"),
                "yaw_error_deg": Measure(before.yaw_error_deg, "deg"),
                "along_mm": Measure(before.along_mm, "mm"),
                "across_mm": Measure(before.across_mm, "mm"),
                "closed_at": Measure(closed_at, "step"),
                "obstacle_touched_at": Measure(touched_at, "step"),
            },
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
