"""A sample of a run: what its processes said of themselves at one moment, as a line of JSON."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from proto.codec import (
    MEBIBYTE,
    Added,
    Integer,
    Many,
    Number,
    Size,
    Wire,
    decode,
    encode,
    message,
    record_of,
    schema_of,
)
from proto.metrics import (
    ActorMetrics,
    Count,
    EpochMetrics,
    Epochs,
    LearnerMetrics,
    Rate,
    Stage,
    SuiteScore,
    Training,
)
from proto.suites import SuiteName
from services.board import RunView

FORMAT: Final = 1
MOST_SCORES: Final = 100
"""A sample holds so many scores; what changed besides comes with the next samples."""


@dataclass(frozen=True, kw_only=True)
class LearnerSample:
    """What the learner said since the sample before; see `proto.metrics.LearnerMetrics`."""

    training: Training
    stage: Stage
    round: Count
    epochs: Epochs
    epochs_per_s: Rate
    sequences: Count
    policy_version: Count


@dataclass(frozen=True, kw_only=True)
class ActorsSample:
    """All living actors together.

    Attributes:
        present: number of actors.
        steps_per_s: control steps per second.
        episodes_per_s: episodes per second since the sample before.
    """

    present: Count
    steps_per_s: Rate
    episodes_per_s: Rate


@dataclass(frozen=True, kw_only=True)
class ScoreSample:
    """Counted trials of a policy version in a suite.

    Attributes:
        suite: name of the suite.
        version: the policy version.
        trials: number of counted trials.
        lenient, strict, precise: number of trials that succeeded in each reading of success.
    """

    suite: SuiteName
    version: Count
    trials: Count
    lenient: Count
    strict: Count
    precise: Count

    def __post_init__(self) -> None:
        """Raise ValueError if there are more successes than trials."""
        if max(self.lenient, self.strict, self.precise) > self.trials:
            raise ValueError(f"{self.suite}: more successes than the {self.trials} trials")


@message("sample", FORMAT, form="json", limit=MEBIBYTE)
@dataclass(frozen=True, kw_only=True)
class Sample:
    """One line of the history.

    Attributes:
        time_s: when it was taken, Unix time (s).
        learner: the learner; None if none is present.
        actors: the actors; None if none is present.
        scores: the scores that have changed since the sample before.
        format: format of the line.
    """

    time_s: Annotated[float, Number(0.0, 1e11)]
    learner: Annotated[LearnerSample | None, Added(record_of(LearnerSample))] = None
    actors: Annotated[ActorsSample | None, Added(record_of(ActorsSample))] = None
    scores: Annotated[
        tuple[ScoreSample, ...],
        Many(record_of(ScoreSample), Size("scores", 0, 10_000)),
    ] = ()
    format: Annotated[int, Integer(FORMAT, FORMAT)] = FORMAT

    @property
    def says_something(self) -> bool:
        """Whether any process was there."""
        return bool(self.learner or self.actors or self.scores)

    def line(self) -> bytes:
        """The line, with a line break at its end."""
        return encode(self).payload + b"\n"

    @classmethod
    def of_line(cls, line: bytes) -> Sample:
        """Read a line.

        Raises:
            MessageError: it is no sample, or one of another format.
        """
        return decode(Wire(schema_of(cls).encoding, line), cls)


class Sampler:
    """Takes samples of what is known of a run."""

    def __init__(self) -> None:
        self._before_s = 0.0
        self._episodes: dict[str, int] = {}
        self._training = ""
        self._told: dict[tuple[str, int], ScoreSample] = {}

    def sample(self, view: RunView, time_s: float, epochs: tuple[EpochMetrics, ...] = ()) -> Sample:
        """Take a sample.

        Args:
            view: what is known at this moment.
            time_s: this moment, Unix time (s).
            epochs: the epochs that the learner has told since the sample before.
        """
        learners = view.living(LearnerMetrics)
        learner = _learner_sample(learners[0], epochs) if learners else None
        if learner is not None and learner.training != self._training:
            self._training = learner.training
            self._told = {}  # another training counts its versions from 1 again
        actors = self._actors_sample(view.living(ActorMetrics), time_s - self._before_s)
        self._before_s = time_s
        return Sample(
            time_s=time_s, learner=learner, actors=actors, scores=self._changed(view.suites)
        )

    def _actors_sample(self, actors: list[ActorMetrics], passed_s: float) -> ActorsSample | None:
        before, self._episodes = self._episodes, {actor.id: actor.episodes for actor in actors}
        if not actors:
            return None
        # An actor that was started again counts from 0 again.
        played = sum(
            count - before[name] if count >= before[name] else count
            for name, count in self._episodes.items()
            if name in before
        )
        return ActorsSample(
            present=len(actors),
            steps_per_s=min(sum(actor.steps_per_s for actor in actors), 1e9),
            episodes_per_s=min(played / max(passed_s, 1e-3), 1e9),
        )

    def _changed(self, suites: Sequence[SuiteScore]) -> tuple[ScoreSample, ...]:
        present = {(score.suite, score.version): score for score in _scores(suites)}
        changed = [s for key, s in present.items() if self._told.get(key) != s][:MOST_SCORES]
        told = {key: score for key, score in self._told.items() if key in present}
        self._told = told | {(score.suite, score.version): score for score in changed}
        return tuple(changed)


def _learner_sample(learner: LearnerMetrics, epochs: tuple[EpochMetrics, ...]) -> LearnerSample:
    return LearnerSample(
        training=learner.training,
        stage=learner.stage,
        round=learner.round,
        epochs=epochs,
        epochs_per_s=learner.epochs_per_s,
        sequences=learner.sequences,
        policy_version=learner.policy_version,
    )


def _scores(suites: Sequence[SuiteScore]) -> Iterator[ScoreSample]:
    for suite in suites:
        for score in suite.policies:
            readings = (score.lenient, score.strict, score.precise)
            lenient, strict, precise = (
                min(reading.successes, score.trials) for reading in readings
            )
            yield ScoreSample(
                suite=suite.name,
                version=score.version,
                trials=score.trials,
                lenient=lenient,
                strict=strict,
                precise=precise,
            )
