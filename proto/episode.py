"""One episode: what was seen, told, done, and how it ended. The unit of tutoring and evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from proto.body import ACTION_SIZE, IMAGE_HEIGHT, IMAGE_WIDTH, JOINT_NAMES
from proto.codec import Added, Array, Integer, Many, Maybe, Number, Size, Table, Text

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]
States = Mapping[str, Floats]

JOINTS: Final = len(JOINT_NAMES)
LARGEST_DEG: Final = 360.0
"""No joint angle or level is larger."""
STEPS: Final = Size("T", 1, 2000)
BODIES: Final = Size("B", 0, 256)
Id = Annotated[str, Text(64, r"[A-Za-z0-9][A-Za-z0-9._-]*")]
"""Names an episode, a process or a run; may stand in a key and in a file name."""


class Kind(StrEnum):
    """Why an episode was played.

    tutoring: the tutor showed a case.
    correction: a policy acted while the tutor guided it; learned from as tutoring is.
    trial: the evaluator asked for it.
    practice: an actor chose a situation itself.
    """

    TUTORING = "tutoring"
    CORRECTION = "correction"
    TRIAL = "trial"
    PRACTICE = "practice"


class Reason(StrEnum):
    """Why an episode fell short of `precise`; the first that applies, in this order."""

    NONE = "none"
    TOUCHED_OBSTACLE = "touched_obstacle"
    MOVED_OBJECT = "moved_object"
    NEVER_CLOSED = "never_closed"
    NOT_LIFTED = "not_lifted"
    IMPRECISE = "imprecise"
    SIMULATION_FAILED = "simulation_failed"


@dataclass(frozen=True)
class Outcome:
    """How an episode ended, in the three readings of success.

    Attributes:
        lenient: the object ended more than 5 cm above its start.
        strict: lifted and held, obstacle untouched, object at most 10 mm moved and 5 degrees
            turned before the hand closed.
        precise: strict, and the hand's pose to the object was right when it closed.
        reason: why it was not precise.
        lifted_m: height of the object above its start at the end (m).
        moved_mm: how far the object was moved before the hand closed.
        turned_deg: how far the object was turned before the hand closed.
        yaw_error_deg: yaw of the hand's grasp axis less the object's when the hand closed, in the
            task frame, -90..90.
        along_mm: offset of the grasp centre along the object's long axis when the hand closed.
        across_mm: offset across it.
        closed_at: control step at which the hand closed, or -1.
        obstacle_touched_at: first control step in which the obstacle was touched, or -1.
    """

    lenient: bool
    strict: bool
    precise: bool
    reason: Reason
    lifted_m: float
    moved_mm: float
    turned_deg: float
    yaw_error_deg: float
    along_mm: float
    across_mm: float
    closed_at: int
    obstacle_touched_at: int


@dataclass(frozen=True)
class Episode:
    """One episode of T control steps.

    At step t the robot sees images[t], is told actions[t], and moves for one control period.

    Attributes:
        id: random hexadecimal id, unique.
        kind: why it was played.
        task: name of the task.
        situation: the situation's values by name, in the paper's task frame.
        seed: seed of everything random in it.
        actor: id of the process that played it.
        backend: name of the simulator.
        policy: name of the policy.
        policy_version: version of the policy, 0 for one never trained.
        config_digest: digest of the effective configuration.
        images: (T, 48, 64) uint8, the network's grey picture before normalization.
        actions: (T, 11) float32, what the robot was told (units of `proto.body`).
        targets: (T, 11) float32, what was meant: the clean plan where the tutor executed it with
            noise or guided a policy, else equal to the actions.
        joints_deg: (T, 18) float32, measured before the action: neck, arm, hand motors.
        phases: (T,) uint8, subtask 1..8 of the paper's Experiment I.
        body_names: names of the bodies, B of them.
        body_poses: (T, B, 7) float32, position (m) and quaternion (w first) in the world frame.
        outcome: how it ended.
        outputs: (T, 110) float32, softmax outputs of the network, or None.
        control_period_s: time from one control step to the next (s).
        states: (T, units) float32 of each subnet by name, its activity, where that was asked for;
            else None.
        training: id of the training that the policy comes from; empty for the tutor and for a
            policy from a file.
    """

    id: Id
    kind: Kind
    task: str
    situation: Annotated[Mapping[str, float], Table(Number(), most=32)]
    seed: Annotated[int, Integer(0, 2**63 - 1)]
    actor: Id
    backend: str
    policy: str
    policy_version: Annotated[int, Integer(0, 2**31)]
    config_digest: str
    images: Annotated[Image, Array("uint8", (STEPS, IMAGE_HEIGHT, IMAGE_WIDTH))]
    actions: Annotated[Floats, Array("float32", (STEPS, ACTION_SIZE), -LARGEST_DEG, LARGEST_DEG)]
    targets: Annotated[Floats, Array("float32", (STEPS, ACTION_SIZE), -LARGEST_DEG, LARGEST_DEG)]
    joints_deg: Annotated[Floats, Array("float32", (STEPS, JOINTS), -LARGEST_DEG, LARGEST_DEG)]
    phases: Annotated[NDArray[np.uint8], Array("uint8", (STEPS,), 1, 8)]
    body_names: Annotated[tuple[str, ...], Many(Text(64), BODIES)]
    body_poses: Annotated[Floats, Array("float32", (STEPS, BODIES, 7), -1e3, 1e3)]
    outcome: Outcome
    outputs: Annotated[
        Floats | None, Maybe(Array("float32", (STEPS, Size("outputs", 1, 4096)), 0.0, 1.001))
    ] = field(default=None)
    control_period_s: Annotated[float, Number(1e-6, 1e3)] = 0.1
    states: Annotated[
        States | None,
        Added(Table(Array("float32", (STEPS, Size("units", 1, 65536, own=True))), most=16)),
    ] = field(default=None)
    training: Annotated[str, Text(64)] = ""

    @property
    def steps(self) -> int:
        """Number of control steps T."""
        return len(self.actions)
