"""Messages between the processes. The annotation of a field defines its check."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Final, Self

from proto.body import ACTION_SIZE, IMAGE_HEIGHT, IMAGE_WIDTH
from proto.codec import (
    MEBIBYTE,
    Added,
    Array,
    Blob,
    Integer,
    Many,
    Maybe,
    Number,
    Size,
    Table,
    Text,
    message,
    record_of,
)
from proto.episode import (
    BODIES,
    JOINTS,
    LARGEST_DEG,
    BoxLook,
    ConditionsField,
    Episode,
    Floats,
    Id,
    Image,
    Kind,
    Outcome,
)
from proto.keys import Role
from proto.seeds import SEEDS_PER_CASE
from proto.suites import Player, suite_of
from proto.variables import SituationField

EPISODE_LIMIT: Final = 32 * MEBIBYTE
OUTSIDE_SIZE: Final = (360, 480, 3)
"""Height, width and channels of the picture from outside that actors publish."""
EYE_SIZE: Final = (240, 320, 3)
"""Height, width and channels of the whole eye's picture that actors publish."""
POLICY_LIMIT: Final = 130 * MEBIBYTE
"""Size of the largest possible network; in a run its own network sets the limit (bytes)."""

Count = Annotated[int, Integer(0, 2**31)]
POLICIES_KEPT: Final = 32
"""An actor keeps so many policies at most, beside the one that it acts with."""
LARGEST_VERSION: Final = 10**6
"""Largest version of a policy. Each version takes an epoch of training at least."""
Seed = Annotated[int, Integer(0, 2**63 - 1)]

LARGEST_LOSS: Final = 1e9

PolicyKey = tuple[str, int]
"""Identifies a policy: id of its training, and its version."""


@message("policy", 1, limit=POLICY_LIMIT + MEBIBYTE)
@dataclass(frozen=True)
class PolicyVersion:
    """A trained network, from the learner to actors and evaluator.

    Attributes:
        run_id: id of the training; a training that starts without a checkpoint has a new id.
        version: 1, 2, ... within a training; it only increases, and never exceeds the epoch.
        epoch: epoch of the coupled training after which it was published.
        loss: training loss at that epoch.
        config_digest: digest of the learner's configuration.
        weights: safetensors file with the network and its metadata.
    """

    run_id: Id
    version: Annotated[int, Integer(1, LARGEST_VERSION)]
    epoch: Count
    loss: Annotated[float, Number(0.0, LARGEST_LOSS)]
    config_digest: str
    weights: Annotated[bytes, Blob(POLICY_LIMIT)]

    def __post_init__(self) -> None:
        """Raise ValueError if there are more versions than epochs."""
        if self.version > self.epoch:
            raise ValueError(f"version {self.version} cannot come after {self.epoch} epochs")


@message("sequence", 4, limit=EPISODE_LIMIT)
@dataclass(frozen=True)
class Sequence:
    """A tutored episode or a correction, from an actor to the learner."""

    episode: Episode


@message("rollout", 3, limit=EPISODE_LIMIT)
@dataclass(frozen=True)
class Rollout:
    """An episode that a network played as a trial or in practice, from an actor to recorders.

    Attributes:
        episode: the episode.
        run_id: id of the training that the policy comes from.
    """

    episode: Episode
    run_id: Id


@message("episode_outcome", 1)
@dataclass(frozen=True)
class EpisodeOutcome:
    """How a trial or an episode of practice ended, from an actor to the evaluator.

    It is all that is counted: the pictures and movements are in the `Rollout` of the same id.

    Attributes:
        id, actor, kind, task, situation, seed, backend, policy_version, config_digest,
            control_period_s, training, conditions, outcome: as in `Episode`.
        steps: number of control steps.
    """

    id: Id
    actor: Id
    kind: Kind
    task: str
    situation: SituationField
    seed: Seed
    backend: str
    policy_version: Count
    config_digest: str
    steps: Count
    control_period_s: Annotated[float, Number(1e-6, 1e3)]
    training: Id
    outcome: Outcome
    conditions: ConditionsField = None

    @property
    def suite(self) -> str:
        """Name of the suite that the episode belongs to."""
        return suite_of(self.conditions)

    @classmethod
    def of(cls, episode: Episode) -> Self:
        """The outcome of an episode."""
        return cls(
            id=episode.id,
            actor=episode.actor,
            kind=episode.kind,
            task=episode.task,
            situation=episode.situation,
            seed=episode.seed,
            backend=episode.backend,
            policy_version=episode.policy_version,
            config_digest=episode.config_digest,
            steps=episode.steps,
            control_period_s=episode.control_period_s,
            training=episode.training,
            outcome=episode.outcome,
            conditions=episode.conditions,
        )


@message("episode_failed", 2)
@dataclass(frozen=True)
class EpisodeFailed:
    """Report that a requested episode has no outcome: its simulation failed, or killed the actor.

    The episode is handed out again. After three failures the evaluator counts the trial as a
    failure, and the learner gives up the tutored case or correction.

    Attributes:
        id: id of the episode.
        actor: id of the actor that played it.
        kind: why it was played. Failures of practice are not reported.
        task: name of the task.
        seed: seed of the episode.
        situation: the situation's values by name.
        training: id of the training that the policy comes from, empty for the tutor.
        policy_version: version of the policy, 0 for the tutor.
        problem: why it has no outcome.
        died: whether the actor's process died while it played the episode.
        conditions: as in `Episode`.
    """

    id: Id
    actor: Id
    kind: Kind
    task: Annotated[str, Text(64)]
    seed: Seed
    situation: SituationField
    training: Annotated[str, Text(64)]
    policy_version: Count
    problem: Annotated[str, Text(1000)]
    died: bool
    conditions: ConditionsField = None

    @property
    def suite(self) -> str:
        """Name of the suite that the episode belongs to."""
        return suite_of(self.conditions)


@message("receipt", 2)
@dataclass(frozen=True)
class Receipt:
    """Reply to an episode or to an `EpisodeFailed`: the sender need not send it again.

    Attributes:
        episode: id of the episode.
        refusal: why the receiver refuses the episode for good; empty if it has stored this episode
            or an equal one.
    """

    episode: Id
    refusal: Annotated[str, Text(1000)] = ""


@message("tutoring_request", 3)
@dataclass(frozen=True)
class TutoringRequest:
    """An actor's request for a `TutoringCase` or a `Correction`.

    Attributes:
        actor: id of the actor.
        run_id: id of the training that its policy comes from, empty if it has no policy.
        policy_version: version of its policy, 0 if it has none.
        config_digest: digest of the actor's settings, see `proto.agreement`.
        player: what it can play.
    """

    actor: Id
    run_id: Annotated[str, Text(64)]
    policy_version: Count
    config_digest: Annotated[str, Text(64)]
    player: Player


@message("tutoring_case", 2)
@dataclass(frozen=True)
class TutoringCase:
    """A tutored case to demonstrate.

    Attributes:
        task: name of the task; pre-training can use another task than coupled training.
        case: index into the task's tutored situations.
        repeat: 0 for the plan without noise; 1, 2, ... for executions with noise.
    """

    task: Annotated[str, Text(64)]
    case: Count
    repeat: Count

    @property
    def seed(self) -> int:
        """Seed of the episode."""
        return self.case * SEEDS_PER_CASE + self.repeat


@message("correction", 2)
@dataclass(frozen=True)
class Correction:
    """A situation in which the actor's policy shall act while the tutor guides it.

    Attributes:
        task: name of the task.
        seed: seed of the episode.
        situation: the situation's values by name.
        conditions: as in `Episode`.
    """

    task: Annotated[str, Text(64)]
    seed: Seed
    situation: SituationField
    conditions: ConditionsField = None


@message("verdict", 3)
@dataclass(frozen=True)
class Verdict:
    """Outcome of an episode of practice. The learner chooses corrections where the policy failed.

    Attributes:
        run_id: id of the training that the policy comes from.
        policy_version: its version.
        task: name of the task.
        seed: seed of the episode.
        situation: the situation's values by name.
        outcome: how it ended.
        backend: name of the simulator that played it.
        conditions: as in `Episode`.
    """

    run_id: Id
    policy_version: Count
    task: Annotated[str, Text(64)]
    seed: Seed
    situation: SituationField
    outcome: Outcome
    backend: str
    conditions: ConditionsField = None


@message("trial_request", 3)
@dataclass(frozen=True)
class TrialRequest:
    """An actor's request for a trial; other fields as in `TutoringRequest`.

    Attributes:
        older: earlier versions of this training that the actor can still act with.
    """

    actor: Id
    run_id: Id
    policy_version: Count
    config_digest: Annotated[str, Text(64)]
    player: Player
    older: Annotated[tuple[int, ...], Many(Integer(0, 2**31), Size("older", 0, POLICIES_KEPT))] = ()


@message("trial", 2)
@dataclass(frozen=True)
class Trial:
    """A trial to play.

    Attributes:
        policy_version: which of the versions of the request shall act.
        seed: seed of the situation and of the episode.
        conditions: as in `Episode`.
    """

    policy_version: Count
    seed: Seed
    conditions: ConditionsField = None


@dataclass(frozen=True)
class Setting:
    """A value of a configuration that must be the same in all processes of a run.

    Attributes:
        key: such as `network.pfc.tau`.
        value: the value as JSON.
    """

    key: Annotated[str, Text(256)]
    value: Annotated[str, Text(1000)]


@message("settings", 1, form="json", limit=MEBIBYTE)
@dataclass(frozen=True)
class Settings:
    """What must agree in the configuration of a process, see `proto.agreement`.

    Question and answer are the same message: a process that joins sends its own.

    Attributes:
        role: role of the process.
        id: id of the process.
        values: the values, sorted by key.
    """

    role: Role
    id: Id
    values: Annotated[tuple[Setting, ...], Many(record_of(Setting), Size("values", 0, 1000))]


@message("configuration_request", 1, form="json")
@dataclass(frozen=True)
class ConfigurationRequest:
    """A joining process's request for the configuration of the run.

    Attributes:
        role: role of the process.
    """

    role: Role


@message("configuration", 1, form="json", limit=MEBIBYTE)
@dataclass(frozen=True)
class RunConfiguration:
    """The effective configuration of the run, from the learner to a process that joins.

    Attributes:
        text: the configuration as JSON.
        digest: digest of the configuration, see `proto.config.Config.digest`.
    """

    text: Annotated[str, Text(MEBIBYTE // 2)]
    digest: Annotated[str, Text(64)]


@message("identity", 1, form="json")
@dataclass(frozen=True)
class Identity:
    """Which process uses the id of an actor; question and answer are the same message.

    Attributes:
        process: random name of the process.
        joined: whether it takes part under this id; otherwise it is about to.
    """

    process: Annotated[str, Text(32, "[0-9a-f]{32}")]
    joined: bool


@message("claim", 1, form="json")
@dataclass(frozen=True)
class Claim:
    """A process wants to be the only one of its role in the run, or is so already.

    Question and answer are the same message.

    Attributes:
        role: the role.
        id: id of the process; another process may have the same one.
        process: a random name, which no other process has.
        works: whether it has the role.
    """

    role: Role
    id: Id
    process: Annotated[str, Text(16, "[0-9a-f]{16}")]
    works: bool


LIVE_SCENE_EVERY: Final = 10
"""The first of so many control steps carries the scene, for viewers that begin to look."""


@dataclass(frozen=True)
class LiveScene:
    """What viewers need of an episode, and what stays the same in it.

    Attributes:
        body_names: names of the B bodies.
        boxes: as in `proto.episode.View`.
        fixed_links: as in `proto.episode.View`.
    """

    body_names: Annotated[tuple[str, ...], Many(Text(64), BODIES)]
    boxes: Annotated[Mapping[str, BoxLook], Table(record_of(BoxLook), most=256)]
    fixed_links: Annotated[Mapping[str, Floats], Table(Array("float32", (7,), -1e3, 1e3), most=256)]


@message("live", 4)
@dataclass(frozen=True)
class Live:
    """One control step as it happens.

    Attributes:
        actor: id of the actor that plays.
        kind: why the episode is played.
        policy: name of the policy.
        policy_version: version of the policy.
        step: control step, from 0.
        phase: name of the phase.
        image: (48, 64) uint8, the network's grey picture.
        joints_deg: (18,) float32, neck, arm and hand as measured.
        action: (11,) float32, the commanded action.
        body_poses: (B, 7) float32, position (m) and quaternion (w first) of each body in the world
            frame, at the same time as the picture.
        focal_px: (2,) float32, as in `proto.episode.View`.
        scene: what does not change in an episode; None in most messages.
        pfc: (units,) float32, activity of the PFC after this step; None for a policy without one,
            such as the tutor.
    """

    actor: Id
    kind: Kind
    policy: str
    policy_version: Count
    step: Count
    phase: Annotated[str, Text(64)]
    image: Annotated[Image, Array("uint8", (IMAGE_HEIGHT, IMAGE_WIDTH))]
    joints_deg: Annotated[Floats, Array("float32", (JOINTS,), -LARGEST_DEG, LARGEST_DEG)]
    action: Annotated[Floats, Array("float32", (ACTION_SIZE,), -LARGEST_DEG, LARGEST_DEG)]
    body_poses: Annotated[Floats, Array("float32", (BODIES, 7), -1e3, 1e3)]
    focal_px: Annotated[Floats, Array("float32", (2,), 1e-3, 1e6)]
    scene: Annotated[LiveScene | None, Added(record_of(LiveScene))] = None
    pfc: Annotated[
        Floats | None, Maybe(Array("float32", (Size("units", 1, 4096),), -10.0, 10.0))
    ] = None


@message("pictures", 1, limit=MEBIBYTE)
@dataclass(frozen=True)
class Pictures:
    """What a scene looks like now, in colour.

    Attributes:
        actor: id of the actor that plays.
        step: control step, from 0.
        outside: (360, 480, 3) uint8 RGB, from outside.
        eye: (240, 320, 3) uint8 RGB, the whole picture of the left eye.
    """

    actor: Id
    step: Count
    outside: Annotated[Image, Array("uint8", OUTSIDE_SIZE)]
    eye: Annotated[Image, Array("uint8", EYE_SIZE)]


class Command(StrEnum):
    """A command to a process.

    pause: stop playing, training or assigning work; still receive messages and reply.
    resume: end the pause.
    checkpoint: write to disk what a restart needs.
    stop: end cleanly.
    """

    PAUSE = "pause"
    RESUME = "resume"
    CHECKPOINT = "checkpoint"
    STOP = "stop"


@message("control", 1, form="json")
@dataclass(frozen=True)
class Control:
    """A command to all processes of a role."""

    command: Command


@message("control_reply", 1, form="json")
@dataclass(frozen=True)
class ControlReply:
    """The reply of one process to a `Control`.

    Attributes:
        role: role of the process.
        id: id of the process.
        note: what it did.
    """

    role: Role
    id: Id
    note: Annotated[str, Text(1000)]
