"""Metrics of a whole run in the format of Prometheus.

All names begin with `vmdnn_`. What comes over the bus cannot make more and more time series: ids
and suites are limited in number, and no other text of a message becomes a label.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from proto.errors import UserError
from proto.keys import Role
from proto.metrics import (
    ActorMetrics,
    EvaluatorMetrics,
    HubMetrics,
    LearnerMetrics,
    Metrics,
    PolicyScore,
    RecorderMetrics,
    Stage,
    SuiteScore,
)
from services.board import ProcessKey, RunView
from services.trials.success import READINGS

PREFIX: Final = "vmdnn_"
MOST_PROCESSES: Final = 500
"""Time series of so many processes; further ones are only counted."""
SHOWN_AFTER_END_S: Final = 600.0
"""A process that has vanished is shown as down for this time."""
_PROCESS: Final = ("role", "id")
"""Labels of what every process tells."""
_MEMBERS: Final = tuple(role for role in Role if role is not Role.WATCH)


@dataclass(frozen=True)
class _Field:
    """A number that a kind of process tells.

    Attributes:
        name: name without the prefix; of a counter also without the suffix `_total`.
        help: what it is, with its unit.
        value: reads it from the metrics; None if there is none yet.
        counts: whether it only grows, as long as the process lives.
    """

    name: str
    help: str
    value: Callable[[Any], float | None]
    counts: bool = False


_EVERY_PROCESS: Final = (
    _Field(
        "process_last_metrics_timestamp_seconds",
        "When the process sent its newest metrics, by its own clock (Unix time).",
        lambda m: m.time_s,
    ),
    _Field(
        "process_messages_refused",
        "Messages that the process dropped because they were invalid or not asked for.",
        lambda m: m.refused,
        counts=True,
    ),
    _Field(
        "process_waiting", "1 while the process waits for something.", lambda m: bool(m.waiting_for)
    ),
    _Field(
        "process_waiting_for_disk",
        "1 while the process waits for a disk that is full or cannot be written.",
        lambda m: m.waiting_for.startswith("the disk"),
    ),
    _Field(
        "process_certificate_expires_days",
        "Days until the certificate of the process expires; left out before the last 30.",
        lambda m: m.certificate_days,
    ),
)
_FIELDS: Final[tuple[tuple[type[Metrics], tuple[_Field, ...]], ...]] = (
    (
        ActorMetrics,
        (
            _Field("actor_steps_per_second", "Control steps per second.", lambda m: m.steps_per_s),
            _Field("actor_episodes", "Episodes finished.", lambda m: m.episodes, counts=True),
            _Field(
                "actor_failed_episodes",
                "Episodes whose simulation failed.",
                lambda m: m.failed,
                counts=True,
            ),
            _Field(
                "actor_policy_version",
                "Policy version that the actor holds, 0 for none.",
                lambda m: m.policy_version,
            ),
            _Field("actor_outbox_episodes", "Episodes without a receipt.", lambda m: m.outbox),
            _Field(
                "actor_messages_put_aside",
                "Messages in the outbox folder that are not sent any more.",
                lambda m: m.put_aside,
            ),
            _Field("actor_paused", "1 while the actor is paused.", lambda m: m.paused),
        ),
    ),
    (
        LearnerMetrics,
        (
            _Field("learner_loss", "Training loss of the last epoch.", lambda m: m.loss),
            _Field(
                "learner_learning_rate",
                "Learning rate of the last epoch.",
                lambda m: m.learning_rate,
            ),
            _Field("learner_epoch", "Epochs done in this stage.", lambda m: m.epoch),
            _Field("learner_epochs_planned", "Epochs of this stage.", lambda m: m.epochs_total),
            _Field("learner_epochs_per_second", "Epochs per second.", lambda m: m.epochs_per_s),
            _Field("learner_sequences", "Stored sequences.", lambda m: m.sequences),
            _Field(
                "learner_policy_version",
                "Newest published policy version.",
                lambda m: m.policy_version,
            ),
            _Field(
                "learner_corrections_round",
                "Round of corrections, 0 before the first.",
                lambda m: m.round,
            ),
            _Field(
                "learner_damaged_files",
                "Files that could not be read or do not fit the run.",
                lambda m: m.damaged,
                counts=True,
            ),
            _Field(
                "learner_given_up",
                "Cases and corrections given up because their simulation failed repeatedly.",
                lambda m: m.given_up,
                counts=True,
            ),
            _Field("learner_paused", "1 while the learner is paused.", lambda m: m.paused),
            _Field("learner_done", "1 when the learner has done its part.", lambda m: m.done),
        ),
    ),
    (
        EvaluatorMetrics,
        (
            _Field("evaluator_leases", "Trials that are being played.", lambda m: m.leases),
            _Field(
                "evaluator_damaged_lines",
                "Lines of the trial log that could not be read.",
                lambda m: m.damaged,
            ),
            _Field("evaluator_paused", "1 while the evaluator is paused.", lambda m: m.paused),
            _Field("evaluator_done", "1 when the evaluator has done its part.", lambda m: m.done),
        ),
    ),
    (
        RecorderMetrics,
        (
            _Field("recorder_episodes", "Episodes written.", lambda m: m.episodes, counts=True),
            _Field("recorder_written_bytes", "Bytes written.", lambda m: m.bytes, counts=True),
            _Field(
                "recorder_dropped_rollouts",
                "Rollouts dropped because the queue was full; actors send them again.",
                lambda m: m.dropped,
                counts=True,
            ),
            _Field(
                "recorder_deleted_recordings",
                "Recordings of practice deleted to make room.",
                lambda m: m.deleted,
                counts=True,
            ),
        ),
    ),
    (HubMetrics, (_Field("hub_sessions", "Sessions connected to the hub.", lambda m: m.peers),)),
)


class RunCollector(Collector):
    """Makes the metrics of a run whenever Prometheus asks for them."""

    def __init__(
        self, run: str, view: Callable[[], RunView | None], connected: Callable[[], bool]
    ) -> None:
        """Make a collector.

        Args:
            run: name of the run.
            view: what is known of the run at this moment; None before the hub was there.
            connected: whether the hub is there at this moment.
        """
        self._run = run
        self._view = view
        self._connected = connected
        self._lock = threading.Lock()  # several scrapes at the same time are possible
        self._shown: set[ProcessKey] = set()

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics; those of which nothing is known have no samples."""
        view = self._view() or RunView(self._run, {}, {})
        shown = self._choose(view)
        connected = "1 while the exporter is connected to the hub."
        yield self._gauge("hub_connected", connected, self._connected())
        yield from self._presence(view, shown)
        yield from self._fields(_EVERY_PROCESS, [view.metrics[key] for key in shown], role=True)
        for kind, fields in _FIELDS:
            told = [m for key in shown if isinstance(m := view.metrics[key], kind)]
            living = [m for m in told if (m.role, m.id) not in view.vanished_s]
            yield from self._fields(fields, living)
        yield self._stages(view)
        yield from self._suites(view.suites)

    def _choose(self, view: RunView) -> list[ProcessKey]:
        """The processes that are shown: the first that came, until they are gone for long."""
        now_s = time.time()
        gone = {key for key, at_s in view.vanished_s.items() if now_s - at_s > SHOWN_AFTER_END_S}
        with self._lock:
            self._shown = {key for key in self._shown if key in view.metrics and key not in gone}
            for key in view.metrics:
                if len(self._shown) >= MOST_PROCESSES:
                    break
                if key not in view.vanished_s:
                    self._shown.add(key)
            return sorted(self._shown)

    def _presence(self, view: RunView, shown: Sequence[ProcessKey]) -> Iterator[Metric]:
        living = [key for key in view.metrics if key not in view.vanished_s]
        count = self._family("processes", "Living processes by role.", ("role",))
        for role in _MEMBERS:
            count.add_metric([self._run, role], sum(key[0] is role for key in living))
        yield count
        yield self._gauge(
            "processes_not_shown",
            f"Living processes beyond the {MOST_PROCESSES} that have time series of their own.",
            len(set(living) - set(shown)),
        )
        up = self._family("process_up", "1 for a living process, 0 for a vanished one.", _PROCESS)
        for key in shown:
            up.add_metric([self._run, *key], key not in view.vanished_s)
        yield up

    def _fields(
        self, fields: Iterable[_Field], told: Sequence[Metrics], *, role: bool = False
    ) -> Iterator[Metric]:
        labels = _PROCESS if role else ("id",)
        for field in fields:
            family = self._family(field.name, field.help, labels, counts=field.counts)
            for metrics in told:
                value = field.value(metrics)
                if value is not None:
                    names = [metrics.role, metrics.id] if role else [metrics.id]
                    family.add_metric([self._run, *names], float(value))
            yield family

    def _stages(self, view: RunView) -> Metric:
        family = self._family(
            "learner_stage", "1 for the stage that the learner is in.", ("id", "stage")
        )
        for learner in view.living(LearnerMetrics)[:1]:
            for stage in Stage:
                family.add_metric([self._run, learner.id, stage], learner.stage is stage)
        return family

    def _suites(self, suites: Sequence[SuiteScore]) -> Iterator[Metric]:
        """Success of the newest policy version with all its trials, or else with any."""
        version = self._family(
            "suite_policy_version", "Policy version whose success is shown.", ("suite",)
        )
        trials = self._family("suite_trials", "Counted trials of this version.", ("suite",))
        playable = self._family(
            "suite_playable", "1 if a present actor can play the suite's trials.", ("suite",)
        )
        rate, low, high = (
            self._family(f"suite_success{end}_ratio", text, ("suite", "reading"))
            for end, text in (
                ("", "Fraction of the trials that succeeded, in each reading of success."),
                ("_low", "Lower end of the 95 % Wilson interval of the success."),
                ("_high", "Upper end of the 95 % Wilson interval of the success."),
            )
        )
        for suite in suites:
            playable.add_metric([self._run, suite.name], not suite.unplayable)
            score = _shown_score(suite)
            if score is None:
                continue
            version.add_metric([self._run, suite.name], score.version)
            trials.add_metric([self._run, suite.name], score.trials)
            for reading in READINGS:
                success = getattr(score, reading)
                labels = [self._run, suite.name, reading]
                rate.add_metric(labels, success.rate)
                low.add_metric(labels, success.wilson95[0])
                high.add_metric(labels, success.wilson95[1])
        yield from (version, trials, playable, rate, low, high)

    def _gauge(self, name: str, text: str, value: float) -> Metric:
        family = self._family(name, text, ())
        family.add_metric([self._run], value)
        return family

    def _family(
        self, name: str, text: str, labels: tuple[str, ...], *, counts: bool = False
    ) -> GaugeMetricFamily | CounterMetricFamily:
        made = CounterMetricFamily if counts else GaugeMetricFamily
        return made(f"{PREFIX}{name}", text, labels=["run", *labels])


@contextmanager
def served(collector: Collector, host: str, port: int) -> Iterator[int]:
    """Serve metrics over HTTP, on a thread of its own, until the context ends.

    Args:
        collector: makes the metrics.
        host: address to listen at.
        port: port to listen at; 0 for any free one.

    Yields:
        The port.

    Raises:
        UserError: it cannot listen there.
    """
    registry = CollectorRegistry(auto_describe=False)
    registry.register(collector)
    try:
        server, thread = start_http_server(port, host, registry)
    except OSError as error:
        raise UserError(
            f"nothing can listen at {host}:{port} ({error.strerror}); choose another port with"
            " --prometheus [HOST:]PORT"
        ) from error
    try:
        yield server.server_port
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _shown_score(suite: SuiteScore) -> PolicyScore | None:
    complete = [score for score in suite.policies if score.trials >= suite.trials]
    return max(complete or suite.policies, key=lambda score: score.version, default=None)
