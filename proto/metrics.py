"""What each process tells about itself about once a second, as JSON; see docs/protocol.md.

All times are seconds; `time_s` is Unix time. `refused` counts the messages that a process dropped
because they were not what they should be.
"""

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

Count = Annotated[int, Integer(0, 2**53)]
Rate = Annotated[float, Number(0.0, 1e9)]
Fraction = Annotated[float, Number(0.0, 1.0)]


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """What all processes tell.

    Attributes:
        role: what it is.
        id: which one it is.
        time_s: when this was said.
        refused: messages dropped so far because they were not valid.
    """

    role: Role
    id: Id
    time_s: Annotated[float, Number(0.0, 1e11)]
    refused: Count


@message("metrics.actor", 3, form="json")
@dataclass(frozen=True, kw_only=True)
class ActorMetrics(Metrics):
    """An actor.

    Attributes:
        policy_version: newest policy it holds, 0 for none yet.
        steps_per_s: control steps per second since the last metrics.
        episodes: episodes it has finished since it started.
        last_outcome: reason of the last episode, `none` for a precise success; null at first.
        last_kind: what the last episode was for; null at first.
        backend: its simulator.
        outbox: episodes without a receipt.
        paused: whether it was told to pause.
    """

    role: Role = Role.ACTOR
    policy_version: Count
    steps_per_s: Rate
    episodes: Count
    last_outcome: Annotated[str | None, Maybe(Text(64))]
    last_kind: Annotated[Kind | None, Maybe(Choice(Kind))]
    backend: str
    outbox: Count
    paused: bool


class Stage(StrEnum):
    """What the learner is at."""

    WAITING = "waiting"
    PRETRAINING = "pretraining"
    COUPLED = "coupled"
    FINISHED = "finished"


@message("metrics.learner", 2, form="json")
@dataclass(frozen=True, kw_only=True)
class LearnerMetrics(Metrics):
    """The learner.

    Attributes:
        stage: waiting for sequences or corrections, pretraining, coupled training, or finished.
        epoch: epochs done in this stage.
        epochs_total: epochs that this stage has.
        loss: loss of the last epoch; null at first.
        sequences: tutored sequences that it keeps, those of pre-training counted.
        round: round of corrections that it waits for or learns from, 0 before the first.
        corrections: corrections of this round that it keeps; 0 unless it waits for them.
        corrections_total: corrections that this round has at most; 0 unless it waits for them.
        epochs_per_s: epochs per second since the last metrics.
        policy_version: newest version published, 0 for none yet.
        paused: whether it was told to pause.
        done: whether what the configuration's `done` asks of the learner is reached.
    """

    role: Role = Role.LEARNER
    stage: Stage
    epoch: Count
    epochs_total: Count
    loss: Annotated[float | None, Maybe(Number(0.0, 1e9))]
    sequences: Count
    round: Count
    corrections: Count
    corrections_total: Count
    epochs_per_s: Rate
    policy_version: Count
    paused: bool
    done: bool


@dataclass(frozen=True)
class Success:
    """How many trials succeeded, by one reading.

    Attributes:
        successes: number of trials that did.
        rate: their share.
        wilson95: low and high end of the 95 % Wilson interval of the rate.
    """

    successes: Count
    rate: Fraction
    wilson95: Annotated[tuple[float, float], Many(Number(0.0, 1.0), Size("ends", 2, 2))]


@dataclass(frozen=True)
class PolicyScore:
    """Counted trials of one policy version, in the three readings of success.

    Attributes:
        version: the policy version.
        trials: trials counted, at least one.
        lenient, strict, precise: see `proto.episode.Outcome`.
        reasons: how many trials fell short of `precise`, by reason.
    """

    version: Count
    trials: Count
    lenient: Success
    strict: Success
    precise: Success
    reasons: Annotated[Mapping[str, int], Table(Integer(0), most=32)]


@message("metrics.evaluator", 1, form="json", limit=4 * MEBIBYTE)
@dataclass(frozen=True, kw_only=True)
class EvaluatorMetrics(Metrics):
    """The evaluator.

    Attributes:
        policies: counts of each policy version that was tried, oldest first.
        leases: trials that are being played now.
        paused: whether it was told to pause.
        done: whether what the configuration's `done` asks of the evaluator is reached.
    """

    role: Role = Role.EVALUATOR
    policies: Annotated[
        tuple[PolicyScore, ...], Many(record_of(PolicyScore), Size("policies", 0, 10_000))
    ]
    leases: Count
    paused: bool
    done: bool


@message("metrics.recorder", 1, form="json")
@dataclass(frozen=True, kw_only=True)
class RecorderMetrics(Metrics):
    """The recorder.

    Attributes:
        episodes: episodes written since it started.
        bytes: bytes written since it started.
        dropped: rollouts that it could not keep up with, or not write.
    """

    role: Role = Role.RECORDER
    episodes: Count
    bytes: Count
    dropped: Count


@message("metrics.hub", 1, form="json")
@dataclass(frozen=True, kw_only=True)
class HubMetrics(Metrics):
    """The hub.

    Attributes:
        peers: sessions connected to it.
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
