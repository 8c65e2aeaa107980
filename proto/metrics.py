"""Metrics that each process publishes about once a second, as JSON; see docs/protocol.md."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Final

from proto.codec import (
    MEBIBYTE,
    Choice,
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
from proto.episode import Id, Kind
from proto.keys import Role
from proto.suites import MOST_SUITES, SuiteName

Count = Annotated[int, Integer(0, 2**53)]
Rate = Annotated[float, Number(0.0, 1e9)]
Fraction = Annotated[float, Number(0.0, 1.0)]
LARGEST_LEARNING_RATE: Final = 1e9
Training = Annotated[str, Text(64)]
"""Id of a training; empty for one without the bus."""


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Metrics of every process.

    Attributes:
        role: role of the process.
        id: id of the process.
        time_s: when the metrics were published (Unix time).
        refused: messages that the process dropped because they were invalid.
        waiting_for: what the process waits for, such as the hub; empty while it works.
        certificate_days: days until its certificate expires, in the last 30; null before, and
            without security.
        running_s: time since the process joined the run (s).
    """

    role: Role
    id: Id
    time_s: Annotated[float, Number(0.0, 1e11)]
    refused: Count
    waiting_for: Annotated[str, Text(500)] = ""
    certificate_days: Annotated[int | None, Maybe(Integer(0, 30))] = None
    running_s: Annotated[float, Number(0.0, 1e10)] = 0.0


@message("metrics.actor", 5, form="json")
@dataclass(frozen=True, kw_only=True)
class ActorMetrics(Metrics):
    """Metrics of an actor.

    Attributes:
        policy_version: version of its newest policy; 0 if it has none.
        steps_per_s: control steps per second since the last metrics.
        episodes: episodes finished since it started.
        last_outcome: reason of the last episode, `none` for a precise success; null before the
            first episode.
        last_kind: why the last episode was played; null before the first episode.
        backend: name of its simulator.
        outbox: episodes that wait for a receipt.
        put_aside: messages of the outbox that are kept on disk but not sent, because the receiver
            refused them or the file is damaged.
        failed: episodes whose simulation failed since the process started.
        paused: whether it is paused.
    """

    role: Role = Role.ACTOR
    policy_version: Count
    steps_per_s: Rate
    episodes: Count
    last_outcome: Annotated[str | None, Maybe(Text(64))]
    last_kind: Annotated[Kind | None, Maybe(Choice(Kind))]
    backend: str
    outbox: Count
    put_aside: Count
    failed: Count
    paused: bool


class Stage(StrEnum):
    """What the learner is doing."""

    WAITING = "waiting"
    PRETRAINING = "pretraining"
    COUPLED = "coupled"
    FINISHED = "finished"


MOST_EPOCHS: Final = 64


@dataclass(frozen=True, kw_only=True)
class EpochMetrics:
    """One epoch of training.

    Attributes:
        stage: pre-training or coupled training.
        epoch: number of the epoch in its stage, from 1.
        loss: its mean loss.
        learning_rate: its learning rate.
    """

    stage: Stage
    epoch: Count
    loss: Annotated[float, Number(0.0, 1e9)]
    learning_rate: Annotated[float, Number(0.0, LARGEST_LEARNING_RATE)]

    def __post_init__(self) -> None:
        """Raise ValueError if nothing is trained in the stage."""
        if self.stage not in (Stage.PRETRAINING, Stage.COUPLED):
            raise ValueError(f"an epoch cannot be of the stage {self.stage}")


Epochs = Annotated[
    tuple[EpochMetrics, ...], Many(record_of(EpochMetrics), Size("epochs", 0, MOST_EPOCHS))
]


@message("metrics.learner", 6, form="json")
@dataclass(frozen=True, kw_only=True)
class LearnerMetrics(Metrics):
    """Metrics of the learner.

    Attributes:
        stage: waiting for sequences or corrections, pretraining, coupled training, or finished.
        epoch: epochs done in this stage.
        epochs_total: number of epochs of this stage.
        epochs_later: number of epochs of the stages after this one.
        loss: loss of the last epoch; null before the first.
        learning_rate: learning rate of the last epoch; null before the first since the process
            started.
        training: id of the training.
        sequences: stored sequences, including those of pre-training.
        sequences_total: number of stored sequences when all tutored cases have come.
        round: number of the current round of corrections; 0 before the first.
        rounds: number of rounds of corrections that the configuration asks for.
        corrections: stored corrections of this round; 0 unless the stage is `waiting`.
        corrections_total: largest number of corrections of this round; 0 unless the stage is
            `waiting`.
        damaged: sequences, policies and checkpoints that could not be read since the process
            started; see its log.
        given_up: tutored cases and corrections that are no longer requested, because their
            simulation failed repeatedly; counted since the process started.
        epochs_per_s: epochs per second since the last metrics.
        epochs: the newest epochs since the last metrics, at most MOST_EPOCHS.
        policy_version: newest published version; 0 if there is none.
        policies_total: number of policy versions that the configuration gives.
        paused: whether it is paused.
        done: whether the learner's part of the configuration's `done` is reached.
    """

    role: Role = Role.LEARNER
    stage: Stage
    epoch: Count
    epochs_total: Count
    epochs_later: Count
    loss: Annotated[float | None, Maybe(Number(0.0, 1e9))]
    learning_rate: Annotated[float | None, Maybe(Number(0.0, LARGEST_LEARNING_RATE))]
    training: Training
    sequences: Count
    sequences_total: Count
    round: Count
    rounds: Count
    corrections: Count
    corrections_total: Count
    damaged: Count
    given_up: Count
    epochs_per_s: Rate
    epochs: Epochs = ()
    policy_version: Count
    policies_total: Count
    paused: bool
    done: bool


@dataclass(frozen=True)
class Success:
    """Number of successful trials in one reading of success.

    Attributes:
        successes: number of successful trials.
        rate: fraction of the trials that succeeded.
        wilson95: lower and upper end of the 95 % Wilson interval of the rate.
    """

    successes: Count
    rate: Fraction
    wilson95: Annotated[tuple[float, float], Many(Number(0.0, 1.0), Size("ends", 2, 2))]


@dataclass(frozen=True)
class PolicyScore:
    """Counted trials of one policy version, in the three readings of success.

    Attributes:
        version: the policy version.
        trials: number of counted trials, at least one.
        lenient, strict, precise: see `proto.episode.Outcome`.
        reasons: number of trials that were not precise, by reason.
    """

    version: Count
    trials: Count
    lenient: Success
    strict: Success
    precise: Success
    reasons: Annotated[Mapping[str, int], Table(Integer(0), most=32)]


Scores = Annotated[
    tuple[PolicyScore, ...], Many(record_of(PolicyScore), Size("policies", 0, 10_000, varies=True))
]


@dataclass(frozen=True)
class SuiteScore:
    """What was counted in one suite.

    Attributes:
        name: name of the suite.
        backend: name of the simulator in which it is played.
        trials: number of trials that each policy version gets.
        unplayable: why none of the present actors can play what is still to be tried, such as
            `no actor has mujoco`; empty if one can.
        policies: the score of each policy version with counted trials, oldest first.
    """

    name: SuiteName
    backend: str
    trials: Count
    unplayable: str
    policies: Scores


@message("metrics.evaluator", 3, form="json", limit=16 * MEBIBYTE)
@dataclass(frozen=True, kw_only=True)
class EvaluatorMetrics(Metrics):
    """Metrics of the evaluator.

    Attributes:
        policies: the score of each policy version in the first suite, oldest first.
        suites: what was counted in each suite, in the order of the configuration.
        leases: trials that are being played.
        damaged: lines of the trial log that could not be read and are not counted.
        paused: whether it is paused.
        done: whether the evaluator's part of the configuration's `done` is reached.
    """

    role: Role = Role.EVALUATOR
    policies: Scores
    suites: Annotated[
        tuple[SuiteScore, ...], Many(record_of(SuiteScore), Size("suites", 1, MOST_SUITES))
    ]
    leases: Count
    damaged: Count
    paused: bool
    done: bool


@message("metrics.recorder", 3, form="json")
@dataclass(frozen=True, kw_only=True)
class RecorderMetrics(Metrics):
    """Metrics of the recorder.

    Attributes:
        episodes: episodes written since it started.
        bytes: bytes written since it started.
        dropped: rollouts that were dropped because its queue was full; their actors send them
            again.
        deleted: recordings of practice that were deleted because of `recorder.keep`.
    """

    role: Role = Role.RECORDER
    episodes: Count
    bytes: Count
    dropped: Count
    deleted: Count


@message("metrics.hub", 3, form="json")
@dataclass(frozen=True, kw_only=True)
class HubMetrics(Metrics):
    """Metrics of the hub.

    Attributes:
        peers: number of Zenoh sessions that are connected to it.
    """

    role: Role = Role.HUB
    peers: Count


METRICS: Final[tuple[type[Metrics], ...]] = (
    ActorMetrics,
    LearnerMetrics,
    EvaluatorMetrics,
    RecorderMetrics,
    HubMetrics,
)
