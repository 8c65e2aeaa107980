"""What the processes say to each other. Fields are checked as their annotations say."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Final

from proto.body import ACTION_SIZE, IMAGE_HEIGHT, IMAGE_WIDTH
from proto.codec import MEBIBYTE, Array, Blob, Integer, Number, Text, message
from proto.episode import JOINTS, LARGEST_DEG, Episode, Floats, Id, Image, Kind, Outcome
from proto.keys import Role
from proto.seeds import SEEDS_PER_CASE
from proto.variables import SituationField

EPISODE_LIMIT: Final = 32 * MEBIBYTE
POLICY_LIMIT: Final = 256 * MEBIBYTE

Count = Annotated[int, Integer(0, 2**31)]
Seed = Annotated[int, Integer(0, 2**63 - 1)]


@message("policy", 1, limit=POLICY_LIMIT + MEBIBYTE)
@dataclass(frozen=True)
class PolicyVersion:
    """A trained network, for everyone who acts or tests.

    Attributes:
        run_id: id of the training; a new one begins when a run is started from nothing.
        version: 1, 2, ... within a training; it never goes back.
        epoch: epoch of the coupled training after which it was published.
        loss: training loss at that epoch.
        config_digest: digest of the learner's configuration.
        weights: safetensors file with the network and its metadata.
    """

    run_id: Id
    version: Annotated[int, Integer(1, 2**31)]
    epoch: Count
    loss: Annotated[float, Number(0.0, 1e9)]
    config_digest: str
    weights: Annotated[bytes, Blob(POLICY_LIMIT)]


@message("sequence", 3, limit=EPISODE_LIMIT)
@dataclass(frozen=True)
class Sequence:
    """A tutored episode or a correction, for the learner."""

    episode: Episode


@message("rollout", 2, limit=EPISODE_LIMIT)
@dataclass(frozen=True)
class Rollout:
    """An episode that a network played, as a trial or for practice, for the evaluator.

    Attributes:
        episode: the whole of it.
        run_id: training that the policy comes from.
    """

    episode: Episode
    run_id: Id


@message("receipt", 1)
@dataclass(frozen=True)
class Receipt:
    """The episode `episode` has arrived and is kept: it need not be sent again."""

    episode: Id


@message("tutoring_request", 2)
@dataclass(frozen=True)
class TutoringRequest:
    """An actor asks for a case to demonstrate, or a situation to be guided in.

    Attributes:
        actor: who asks.
        run_id: training that its policy comes from, empty if it has none.
        policy_version: its policy's version, 0 if it has none.
    """

    actor: Id
    run_id: Annotated[str, Text(64)]
    policy_version: Count


@message("tutoring_case", 2)
@dataclass(frozen=True)
class TutoringCase:
    """A case to demonstrate.

    Attributes:
        task: name of the task; that of pre-training is another than the one that is tested.
        case: index into the task's tutored situations.
        repeat: 0 for the clean plan, 1, 2, ... for executions with noise.
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
    """A situation in which the policy of the request is to act while the tutor guides it.

    Attributes:
        task: name of the task.
        seed: seed of the episode.
        situation: the situation's values by name.
    """

    task: Annotated[str, Text(64)]
    seed: Seed
    situation: SituationField


@message("verdict", 2)
@dataclass(frozen=True)
class Verdict:
    """How an episode of practice ended; it tells the learner where tutoring is needed.

    Attributes:
        run_id: training that the policy comes from.
        policy_version: its version.
        task: name of the task.
        seed: seed of the episode.
        situation: the situation's values by name.
        outcome: how it ended.
    """

    run_id: Id
    policy_version: Count
    task: Annotated[str, Text(64)]
    seed: Seed
    situation: SituationField
    outcome: Outcome


@message("trial_request", 1)
@dataclass(frozen=True)
class TrialRequest:
    """An actor asks for a trial of the policy that it holds."""

    actor: Id
    run_id: Id
    policy_version: Count


@message("trial", 1)
@dataclass(frozen=True)
class Trial:
    """A trial to play with the policy version of the request.

    Attributes:
        seed: seed of the situation and of the episode.
    """

    seed: Seed


@message("live", 3)
@dataclass(frozen=True)
class Live:
    """One control step as it happens.

    Attributes:
        actor: who plays.
        kind: why.
        policy: name of the policy.
        policy_version: its version.
        step: control step, from 0.
        phase: name of the phase.
        image: (48, 64) uint8, the network's grey picture.
        joints_deg: (18,) float32, neck, arm and hand as measured.
        action: (11,) float32, what the robot is told.
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


class Command(StrEnum):
    """What a process can be told.

    pause: stop playing, training or handing out; keep receiving and answering.
    resume: end the pause.
    checkpoint: write to disk what a restart would need.
    stop: end cleanly.
    """

    PAUSE = "pause"
    RESUME = "resume"
    CHECKPOINT = "checkpoint"
    STOP = "stop"


@message("control", 1, form="json")
@dataclass(frozen=True)
class Control:
    """Tells all processes of a role what to do."""

    command: Command


@message("control_reply", 1, form="json")
@dataclass(frozen=True)
class ControlReply:
    """What one process says to a `Control`.

    Attributes:
        role: what it is.
        id: which one it is.
        note: what it did.
    """

    role: Role
    id: Id
    note: Annotated[str, Text(1000)]
