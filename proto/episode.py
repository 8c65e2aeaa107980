"""One episode: pictures, actions, joints, bodies and outcome. The unit of tutoring and trials."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from proto.body import ACTION_SIZE, IMAGE_HEIGHT, IMAGE_WIDTH, JOINT_NAMES
from proto.codec import (
    Added,
    Array,
    Integer,
    Many,
    Maybe,
    Number,
    Size,
    Table,
    Text,
    record_of,
)
from proto.suites import Conditions, suite_of
from proto.variables import SituationField

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]
States = Mapping[str, Floats]

JOINTS: Final = len(JOINT_NAMES)
LARGEST_DEG: Final = 360.0
"""Largest magnitude of a joint angle or a level in an episode."""
STEPS: Final = Size("T", 1, 2000)
BODIES: Final = Size("B", 0, 256)
PHASES: Final = Size("phases", 1, 255)
Id = Annotated[str, Text(64, r"[A-Za-z0-9][A-Za-z0-9._-]*")]
"""Id of an episode, a process or a run. It is valid as part of a key and of a file name."""


class Kind(StrEnum):
    """Why an episode was played.

    tutoring: the tutor demonstrated a case.
    correction: a policy acted while the tutor guided it; the learner learns from it too.
    trial: the evaluator requested it.
    practice: an actor drew a random situation.
    """

    TUTORING = "tutoring"
    CORRECTION = "correction"
    TRIAL = "trial"
    PRACTICE = "practice"


LOCAL: Final = "local"
"""Actor of an episode that was played without the bus."""
NO_FAILURE: Final = "none"
"""The `reason` of a precise outcome."""
ReasonField = Annotated[str, Text(64, r"[a-z][a-z0-9_]*")]


@dataclass(frozen=True)
class Measure:
    """A number that the judge measured in an episode.

    Attributes:
        value: the number.
        unit: unit of the value, such as `mm`, `deg` or `step`; empty if it has none.
    """

    value: Annotated[float, Number()]
    unit: Annotated[str, Text(16)]


@dataclass(frozen=True)
class Outcome:
    """How an episode ended, in three readings of success. The task defines the three criteria.

    Attributes:
        lenient: success by the paper's criterion.
        strict: success by a criterion that a policy without vision seldom meets.
        precise: strict success with a precisely placed hand.
        reason: why the episode was not precise, in a word of the task such as `not_lifted`;
            NO_FAILURE if it was precise.
        measures: the task's measures by name.
    """

    lenient: bool
    strict: bool
    precise: bool
    reason: ReasonField
    measures: Annotated[Mapping[str, Measure], Table(record_of(Measure), most=64)]

    def __post_init__(self) -> None:
        """Check that precise implies strict, strict implies lenient, and the reason fits.

        Raises:
            ValueError: they contradict each other.
        """
        if self.precise > self.strict or self.strict > self.lenient:
            raise ValueError("an outcome that is precise is strict, and one that is strict lenient")
        if self.precise != (self.reason == NO_FAILURE):
            raise ValueError(f"reason {self.reason!r} does not fit precise = {self.precise}")

    def value(self, measure: str) -> float:
        """Return the value of a measure; KeyError if the task has no such measure."""
        return self.measures[measure].value


SIMULATION_FAILED: Final = Outcome(False, False, False, "simulation_failed", {})
"""Outcome of a trial whose simulation failed; it has no measures."""
NOT_FINISHED: Final = Outcome(False, False, False, "could_not_be_finished", {})
"""Outcome of a trial that killed each actor that played it; it has no measures."""
UNKNOWN_OUTCOME: Final = Outcome(False, False, False, "unknown", {})
"""Outcome of a sequence that nobody judged, such as one that was imported."""


Axes = Annotated[tuple[float, float, float], Many(Number(0.0, 1e3), Size("axes", 3, 3))]


@dataclass(frozen=True)
class BoxLook:
    """How a box looks.

    Attributes:
        size_m: full edge lengths along its own x, y, z (m).
        colour: red, green, blue in 0..1, linear.
    """

    size_m: Axes
    colour: Axes


@dataclass(frozen=True)
class View:
    """What a viewer needs besides the poses of what moves.

    Attributes:
        boxes: the boxes by name; their poses are among the episode's bodies.
        fixed_links: (7,) float32 of each link of the robot that never moves, by name: position (m)
            and quaternion (w first) in the world frame.
        focal_px: (T, 2) float32, focal lengths across and down of the camera that took images[t],
            in pixels of this image; the optical axis is in the image's middle.
    """

    boxes: Annotated[Mapping[str, BoxLook], Table(record_of(BoxLook), most=256)]
    fixed_links: Annotated[Mapping[str, Floats], Table(Array("float32", (7,), -1e3, 1e3), most=256)]
    focal_px: Annotated[Floats, Array("float32", (STEPS, 2), 1e-3, 1e6)]


ConditionsField = Annotated[Conditions | None, Added(record_of(Conditions))]
"""Conditions as a field of a message."""


@dataclass(frozen=True)
class Episode:
    """One episode of T control steps.

    At step t the robot sees images[t], receives the command actions[t], and moves for one control
    period.

    Attributes:
        id: random hexadecimal id, unique.
        kind: why it was played.
        task: name of the task.
        situation: the values of the task's variables by name, in the paper's task frame; empty if
            they are not known.
        seed: seed of all random numbers in the episode.
        actor: id of the process that played it.
        backend: name of the simulator.
        policy: name of the policy.
        policy_version: version of the policy; 0 if it was not trained.
        config_digest: digest of the effective configuration.
        images: (T, 48, 64) uint8, the network's grey picture before normalization.
        actions: (T, 11) float32, the commanded actions (units of `proto.body`).
        targets: (T, 11) float32, the actions to learn: the tutor's plan without noise if the tutor
            executed it with noise or guided a policy; otherwise equal to `actions`.
        joints_deg: (T, 18) float32, measured before the action: neck, arm, hand motors.
        phase_names: names of the task's phases in their order.
        phases: (T,) uint8, index into phase_names of each step.
        body_names: names of the B bodies.
        body_poses: (T, B, 7) float32, position (m) and quaternion (w first) in the world frame.
        outcome: how it ended.
        outputs: (T, 110) float32, softmax outputs of the network; None for other policies.
        control_period_s: time from one control step to the next (s).
        states: activity (T, units) float32 of each subnet by name; None if it was not recorded.
        training: id of the training that the policy comes from; empty for the tutor and for a
            policy from a file.
        started_s: when it was played, Unix time (s); None if this is not known.
        view: what a viewer needs besides; None if this is not known.
        conditions: the conditions of the suite that it belongs to; None for those of `unlearned`.
    """

    id: Id
    kind: Kind
    task: str
    situation: SituationField
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
    phase_names: Annotated[tuple[str, ...], Many(Text(64), PHASES)]
    phases: Annotated[NDArray[np.uint8], Array("uint8", (STEPS,))]
    body_names: Annotated[tuple[str, ...], Many(Text(64), BODIES)]
    body_poses: Annotated[Floats, Array("float32", (STEPS, BODIES, 7), -1e3, 1e3)]
    outcome: Outcome
    outputs: Annotated[
        Floats | None, Maybe(Array("float32", (STEPS, Size("outputs", 1, 4096)), 0.0, 1.001))
    ] = field(default=None)
    control_period_s: Annotated[float, Number(1e-6, 1e3)] = 0.1
    states: Annotated[
        States | None,
        Added(Table(Array("float32", (STEPS, Size("units", 1, 65536, varies=True))), most=16)),
    ] = field(default=None)
    training: Annotated[str, Text(64)] = ""
    started_s: Annotated[float | None, Added(Number(0.0, 1e10))] = None
    view: Annotated[View | None, Added(record_of(View))] = None
    conditions: ConditionsField = None

    def __post_init__(self) -> None:
        """Raise ValueError if a step's phase has no name."""
        if len(self.phases) and int(self.phases.max()) >= len(self.phase_names):
            raise ValueError(
                f"phases: a step is in phase {self.phases.max()} of {len(self.phase_names)}"
            )

    @property
    def suite(self) -> str:
        """Name of the suite that it belongs to."""
        return suite_of(self.conditions)

    @property
    def steps(self) -> int:
        """Number of control steps T."""
        return len(self.actions)
