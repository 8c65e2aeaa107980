"""Judges the three readings of success in Experiment I.

- lenient, the paper's criterion: at the end the object is more than 5 cm above its start;
- strict: the object is lifted and held, the obstacle is never touched, and before the hand closes
  the object moves by at most 10 mm and turns by at most 5 degrees;
- precise: strict, and when the hand closes its yaw error is at most 10 degrees and its offset from
  the object at most 20 mm along and 10 mm across the object's long axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.simulator import Pose, StepReport
from actors.tasks.experiment1.world import object_pose
from actors.tasks.grasp_reading import (
    GraspTolerance,
    HandOffset,
    closed_at,
    half_turn,
    hand_offset,
    yaw_deg,
)
from proto.episode import NO_FAILURE, Measure, Outcome
from proto.variables import Situation
from sim_assets.icub import HAND

Array = NDArray[np.float64]

LIFTED_M: Final = 0.05
HELD_STEPS: Final = 5
MOVED_MM: Final = 10.0
TURNED_DEG: Final = 5.0
TOLERANCE: Final = GraspTolerance(yaw_error_deg=10.0, along_mm=20.0, across_mm=10.0)

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


@dataclass(frozen=True)
class _Approach:
    """Hand and object at the end of the approach.

    Attributes:
        moved_mm: horizontal distance of the object from its start.
        turned_deg: magnitude of the object's rotation since its start.
        hand: pose of the hand relative to the object.
    """

    moved_mm: float
    turned_deg: float
    hand: HandOffset


class Experiment1Judge:
    """Judges one episode from the true poses of the bodies and the measured hand joints.

    Measures: `lifted_m`, height of the object above its start at the end; the attributes of
    `_Approach` and `HandOffset` at the last step before the hand closed (at the last step if it
    never closed); `closed_at`, the step at which the hand closed, or -1; `obstacle_touched_at`, the
    first step in which the obstacle was touched, or -1.
    """

    def __init__(self, situation: Situation) -> None:
        """Prepare to judge an episode in a situation."""
        self._start = object_pose(situation)
        self._instants: list[_Instant] = []

    def watch(self, report: StepReport, joints_deg: Array, bodies: Mapping[str, Pose]) -> None:
        """Record one control step after it was simulated."""
        touched = any(box == "obstacle" for box, _ in report.touches)
        self._instants.append(_Instant(joints_deg, touched, bodies))

    def outcome(self) -> Outcome:
        """Judge the episode; to be called after its last step was recorded."""
        instants = self._instants
        closed_step = closed_at(instant.joints_deg for instant in instants)
        # The approach ends at the last instant at which the hand is open.
        before = self._approach(
            instants[max(closed_step - 1, 0)] if closed_step >= 0 else instants[-1]
        )
        touched_at = next((k for k, instant in enumerate(instants) if instant.touched), -1)
        lifted_m = [self._lifted_m(instant) for instant in instants[-HELD_STEPS:]]
        lenient = lifted_m[-1] > LIFTED_M
        held = min(lifted_m) > LIFTED_M
        unmoved = before.moved_mm <= MOVED_MM and before.turned_deg <= TURNED_DEG
        strict = held and unmoved and closed_step >= 0 and touched_at < 0
        right = TOLERANCE.allows(before.hand)
        failures = (
            (touched_at >= 0, TOUCHED_OBSTACLE),
            (not unmoved, MOVED_OBJECT),
            (closed_step < 0, NEVER_CLOSED),
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
                "yaw_error_deg": Measure(before.hand.yaw_error_deg, "deg"),
                "along_mm": Measure(before.hand.along_mm, "mm"),
                "across_mm": Measure(before.hand.across_mm, "mm"),
                "closed_at": Measure(closed_step, "step"),
                "obstacle_touched_at": Measure(touched_at, "step"),
            },
        )

    def _lifted_m(self, instant: _Instant) -> float:
        return instant.bodies["object"].position_m[2] - self._start.position_m[2]

    def _approach(self, instant: _Instant) -> _Approach:
        body = instant.bodies["object"]
        moved = np.subtract(body.position_m, self._start.position_m)
        return _Approach(
            moved_mm=1e3 * float(np.hypot(moved[0], moved[1])),
            turned_deg=float(abs(half_turn(yaw_deg(body) - yaw_deg(self._start)))),
            hand=hand_offset(instant.bodies[HAND], body),
        )
