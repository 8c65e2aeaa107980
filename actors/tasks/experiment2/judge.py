"""Reads the three readings of success in Experiment II.

- lenient, the paper's: the indicated object ends more than 5 cm above its start;
- strict: it alone was lifted and held; before the hand closed it was moved by at most 10 mm and not
  toppled; the other object was never moved by more than 5 mm;
- precise: strict, and the hand's pose to the object was right when it closed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from actors.simulator import Pose, StepReport
from actors.tasks.experiment2.setting import PlacedObject, Setting
from actors.tasks.experiment2.world import first_steps
from actors.tasks.grasp_reading import (
    GraspTolerance,
    HandOffset,
    closed_at,
    grasp_centre_m,
    hand_offset,
    tilt_deg,
)
from proto.episode import NO_FAILURE, Measure, Outcome
from proto.variables import Situation
from sim_assets.icub import EYE, HAND

Array = NDArray[np.float64]

LIFTED_M: Final = 0.05
HELD_STEPS: Final = 5
MOVED_MM: Final = 10.0
TOPPLED_DEG: Final = 15.0
OTHER_MOVED_MM: Final = 5.0
TOLERANCE: Final = GraspTolerance(yaw_error_deg=8.0, along_mm=15.0, across_mm=10.0)

ATTEND_OBJECT: Final = "attend object"

WRONG_OBJECT: Final = "wrong_object"
OTHER_MOVED: Final = "other_moved"
TOPPLED: Final = "toppled"
MOVED_OBJECT: Final = "moved_object"
NEVER_CLOSED: Final = "never_closed"
NOT_LIFTED: Final = "not_lifted"
IMPRECISE: Final = "imprecise"


@dataclass(frozen=True)
class _Instant:
    """The state after one control step."""

    joints_deg: Array
    hand: Pose
    eye: Pose
    indicated: Pose
    other: Pose


@dataclass(frozen=True)
class _Approach:
    """How the hand came to the object.

    Attributes:
        moved_mm: how far the indicated object had moved sideways.
        tilted_deg: how far it had tilted.
        distance_mm: from the grasp centre to the centre of the indicated object.
        other_distance_mm: from the grasp centre to the centre of the other object.
        hand: pose of the hand relative to the indicated object.
    """

    moved_mm: float
    tilted_deg: float
    distance_mm: float
    other_distance_mm: float
    hand: HandOffset


class Experiment2Judge:
    """Judges one episode from true poses and the measured hand.

    Measures: `gaze_deg` and `other_gaze_deg`, the angles between the eye's optical axis and the
    directions of the indicated and of the other object at the end of `attend object`; `lifted_m`
    and `other_lifted_m`, heights of the objects above their starts at the end; `other_moved_mm`,
    the farthest that the other object ever was from its start; the attributes of `_Approach` and
    `HandOffset` at the last step before the hand closed; `closed_at`, the step at which it closed,
    -1 if it did not.
    """

    def __init__(self, situation: Situation, subtasks: Mapping[str, int]) -> None:
        """Start watching an episode of `situation`.

        Args:
            situation: the values of the task's variables.
            subtasks: the subtasks in their order, and the number of control steps of each.
        """
        setting = Setting.of(situation)
        self._attended_at = first_steps(subtasks)[ATTEND_OBJECT] + subtasks[ATTEND_OBJECT] - 1
        self._indicated, self._other = setting.indicated, setting.other
        self._instants: list[_Instant] = []

    def watch(self, report: StepReport, joints_deg: Array, bodies: Mapping[str, Pose]) -> None:  # noqa: ARG002
        """Take note of one control step that has just been run."""
        self._instants.append(
            _Instant(
                joints_deg=joints_deg,
                hand=bodies[HAND],
                eye=bodies[EYE],
                indicated=bodies[self._indicated.name],
                other=bodies[self._other.name],
            )
        )

    def outcome(self) -> Outcome:
        """How the episode went, once its last step was watched."""
        instants = self._instants
        closed_step = closed_at(instant.joints_deg for instant in instants)
        # The last instant at which the hand was still open tells how it came to the object.
        before = self._approach(
            instants[max(closed_step - 1, 0)] if closed_step >= 0 else instants[-1]
        )
        attended = instants[self._attended_at]
        lifted_m = [
            _height_m(self._indicated, instant.indicated) for instant in instants[-HELD_STEPS:]
        ]
        other_lifted_m = _height_m(self._other, instants[-1].other)
        other_moved_mm = max(_moved_mm(self._other, instant.other) for instant in instants)
        failures = (
            (
                other_lifted_m > LIFTED_M or before.other_distance_mm < before.distance_mm,
                WRONG_OBJECT,
            ),
            (other_moved_mm > OTHER_MOVED_MM, OTHER_MOVED),
            (before.tilted_deg > TOPPLED_DEG, TOPPLED),
            (before.moved_mm > MOVED_MM, MOVED_OBJECT),
            (closed_step < 0, NEVER_CLOSED),
            (min(lifted_m) <= LIFTED_M, NOT_LIFTED),
            (not TOLERANCE.allows(before.hand), IMPRECISE),
        )
        reason = next((reason for failed, reason in failures if failed), NO_FAILURE)
        return Outcome(
            lenient=lifted_m[-1] > LIFTED_M,
            strict=reason in {IMPRECISE, NO_FAILURE},
            precise=reason == NO_FAILURE,
            reason=reason,
            measures={
                "gaze_deg": Measure(_gaze_deg(attended.eye, attended.indicated), "deg"),
                "other_gaze_deg": Measure(_gaze_deg(attended.eye, attended.other), "deg"),
                "lifted_m": Measure(lifted_m[-1], "m"),
                "other_lifted_m": Measure(other_lifted_m, "m"),
                "other_moved_mm": Measure(other_moved_mm, "mm"),
                "moved_mm": Measure(before.moved_mm, "mm"),
                "tilted_deg": Measure(before.tilted_deg, "deg"),
                "distance_mm": Measure(before.distance_mm, "mm"),
                "other_distance_mm": Measure(before.other_distance_mm, "mm"),
                "yaw_error_deg": Measure(before.hand.yaw_error_deg, "deg"),
                "along_mm": Measure(before.hand.along_mm, "mm"),
                "across_mm": Measure(before.hand.across_mm, "mm"),
                "closed_at": Measure(closed_step, "step"),
            },
        )

    def _approach(self, instant: _Instant) -> _Approach:
        moved = np.subtract(instant.indicated.position_m, self._indicated.pose.position_m)
        return _Approach(
            moved_mm=1e3 * float(np.hypot(moved[0], moved[1])),
            tilted_deg=tilt_deg(instant.indicated),
            distance_mm=_distance_mm(instant.hand, instant.indicated),
            other_distance_mm=_distance_mm(instant.hand, instant.other),
            hand=hand_offset(instant.hand, instant.indicated),
        )


def _gaze_deg(eye: Pose, body: Pose) -> float:
    """Angle between the eye's optical axis, its x axis, and the direction of a body."""
    axis = Rotation.from_quat(eye.quaternion, scalar_first=True).apply((1.0, 0.0, 0.0))
    direction = np.subtract(body.position_m, eye.position_m)
    cosine = float(np.dot(axis, direction) / np.linalg.norm(direction))
    return math.degrees(math.acos(min(cosine, 1.0)))  # rounding may exceed 1


def _height_m(placed: PlacedObject, now: Pose) -> float:
    """Height of an object above its start."""
    return now.position_m[2] - placed.pose.position_m[2]


def _moved_mm(placed: PlacedObject, now: Pose) -> float:
    """Distance of an object from its start."""
    return 1e3 * float(np.linalg.norm(np.subtract(now.position_m, placed.pose.position_m)))


def _distance_mm(hand: Pose, body: Pose) -> float:
    return 1e3 * float(np.linalg.norm(grasp_centre_m(hand) - body.position_m))
