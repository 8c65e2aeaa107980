"""A real recorder process on a real bus records every rollout once."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fitting import fitting_fields, make_policy
from outcomes import TOUCHED
from ports import free_endpoint
from processes import eventually, stop, vmdnn
from run_metrics import ACTOR, EVALUATOR, LEARNER
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from learner.checkpoint import checkpoint_from_bytes
from proto.bus import Bus, open_bus, open_hub
from proto.config import HubConfig
from proto.episode import Episode, Kind
from proto.keys import Role
from proto.messages import Receipt, Rollout
from proto.metrics import EpochMetrics, RecorderMetrics, Stage
from proto.periodic import every
from proto.recordings.episodes import read_episode
from services.monitoring.history import history_file, read_history

MakeEpisode = Callable[..., Episode]

RUN = "recorded"
PLAYED_S = 1767323045.5
"""2026-01-02 03:04:05.5 UTC."""


@pytest.fixture
def hub() -> Iterator[HubConfig]:
    config = HubConfig(endpoint=free_endpoint())
    with open_hub(config, RUN, "hub"):
        yield config


def recorder(
    hub: HubConfig, folder: Path, *settings: str
) -> AbstractContextManager[subprocess.Popen[bytes]]:
    words = ["--connect", hub.endpoint]
    for setting in (f"run.folder={folder}", f"run.name={RUN}", *settings):
        words += ["--set", setting]
    return vmdnn("recorder", *words)


class Listener:
    """Receives the recorder's metrics."""

    def __init__(self, bus: Bus) -> None:
        self._newest: RecorderMetrics | None = None
        self._changed = threading.Condition()
        bus.subscribe(bus.keys.metrics(Role.RECORDER), self._listen, RecorderMetrics)

    def wait_for(self, ready: Callable[[RecorderMetrics], bool]) -> RecorderMetrics:
        """Wait for metrics for which `ready` returns true, and return them."""

        def is_ready() -> bool:
            return self._newest is not None and ready(self._newest)

        with self._changed:
            assert self._changed.wait_for(is_ready, timeout=60), f"the last metrics: {self._newest}"
            assert self._newest is not None
            return self._newest

    def forget(self) -> None:
        with self._changed:
            self._newest = None

    def _listen(self, metrics: RecorderMetrics) -> None:
        with self._changed:
            self._newest = metrics
            self._changed.notify_all()


@pytest.fixture
def rollout(make_episode: MakeEpisode) -> Callable[..., Rollout]:
    def make(name: str, trial: int | None = 0, started_s: float | None = None) -> Rollout:
        fields = fitting_fields()
        steps = len(fields["phases"])
        episode = make_episode(
            steps,
            id=name,
            actor="actor",
            kind=Kind.PRACTICE if trial is None else Kind.TRIAL,
            started_s=started_s,
            outputs=np.full((steps, 110), 0.1, dtype=np.float32),
            **fields,
        )
        return Rollout(episode=episode, run_id="training")

    return make


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / RUN / "rollouts").iterdir())


def test_every_rollout_is_kept_once(
    hub: HubConfig, rollout: Callable[..., Rollout], tmp_path: Path
) -> None:
    with open_bus(hub, RUN, Role.ACTOR, "actor") as bus, recorder(hub, tmp_path) as process:
        listener = Listener(bus)
        receipts: list[Receipt] = []
        bus.subscribe(bus.keys.receipt(Role.RECORDER, "actor"), receipts.append, Receipt)
        listener.wait_for(lambda metrics: metrics.episodes == 0)
        sent = [rollout(f"rollout{n}", n or None, started_s=PLAYED_S - n / 1000) for n in range(5)]
        for message in [*sent, *sent[:2]]:
            bus.deliver(bus.keys.rollout("actor"), message)
        metrics = listener.wait_for(lambda metrics: metrics.episodes == 5)
        assert (metrics.dropped, metrics.refused, metrics.deleted) == (0, 0, 0)
        eventually(lambda: len(receipts) == 7, "a receipt each time")
        assert {receipt.episode for receipt in receipts} == {f"rollout{n}" for n in range(5)}
        # The names sort by the time at which the episodes were played: the last one first here.
        names = [f"20260102-030405-{500 - n:03d}_rollout{n}.mcap" for n in (4, 3, 2, 1, 0)]
        assert files(tmp_path) == names
        kept = read_episode(tmp_path / RUN / "rollouts" / names[1])
        assert np.array_equal(kept.images, sent[3].episode.images)
        assert kept.outcome == sent[3].episode.outcome
        assert stop(process) == 0


def test_what_is_no_episode_of_the_task_is_refused(
    hub: HubConfig, rollout: Callable[..., Rollout], tmp_path: Path
) -> None:
    def changed(name: str, **fields: object) -> Rollout:
        sent = rollout(name)
        return replace(sent, episode=replace(sent.episode, **fields))

    with open_bus(hub, RUN, Role.ACTOR, "actor") as bus, recorder(hub, tmp_path):
        listener = Listener(bus)
        receipts: list[Receipt] = []
        bus.subscribe(bus.keys.receipt(Role.RECORDER, "actor"), receipts.append, Receipt)
        listener.wait_for(lambda metrics: metrics.episodes == 0)
        actions = rollout("any").episode.actions
        outside = {"obstacle_x_m": 5.0, "object_y_m": 0.25, "object_yaw_deg": 0.0}
        sent = [
            changed("elsewhere", situation=outside),
            changed("wild", actions=np.full_like(actions, 300.0)),
            changed("slow", control_period_s=3.0),
            rollout("good"),
        ]
        for message in sent:
            bus.deliver(bus.keys.rollout("actor"), message)
        metrics = listener.wait_for(lambda metrics: metrics.episodes == 1)
        assert metrics.refused == 3
        eventually(lambda: len(receipts) == 4, "a receipt or a refusal for each")
        refused = {receipt.episode: receipt.refusal for receipt in receipts}
        assert "obstacle_x_m" in refused["elsewhere"]
        assert "actions" in refused["wild"]
        assert "control steps take 3.0 s" in refused["slow"]
        assert refused["good"] == ""
        assert files(tmp_path) == ["good.mcap"]


def test_a_restarted_recorder_continues_and_can_keep_trials_only(
    hub: HubConfig, rollout: Callable[..., Rollout], tmp_path: Path
) -> None:
    with open_bus(hub, RUN, Role.ACTOR, "actor") as bus:
        listener = Listener(bus)
        for number in (0, 1):
            with recorder(hub, tmp_path, "recorder.practice=false") as process:
                listener.wait_for(lambda metrics: metrics.episodes == 0)
                bus.deliver(bus.keys.rollout("actor"), rollout("practised", None))
                bus.deliver(bus.keys.rollout("actor"), rollout("before", 7))
                bus.deliver(bus.keys.rollout("actor"), rollout(f"during{number}", number))
                # the second time, `before` is there already
                listener.wait_for(lambda metrics, number=number: metrics.episodes == 2 - number)
                process.kill()
                process.wait()
                listener.forget()
    assert files(tmp_path) == ["before.mcap", "during0.mcap", "during1.mcap"]


def test_the_history_of_the_run_is_kept(
    hub: HubConfig, rollout: Callable[..., Rollout], tmp_path: Path
) -> None:
    """Loss, rates, success, the weights of a policy and the pictures of a failure."""
    folder = tmp_path / RUN
    epoch = EpochMetrics(stage=Stage.COUPLED, epoch=120, loss=0.5, learning_rate=0.001)
    learner = replace(LEARNER, epochs=(epoch,))
    with (
        open_bus(hub, RUN, Role.ACTOR, "a-1") as actor,
        open_bus(hub, RUN, Role.LEARNER, "l") as learning,
        open_bus(hub, RUN, Role.EVALUATOR, "e") as evaluating,
    ):
        for bus in (actor, learning, evaluating):
            bus.announce()
        policy = make_policy(3, "t-1")
        learning.publish_newest(learning.keys.policy, policy)
        tell = {
            actor: ACTOR,
            learning: learner,
            evaluating: EVALUATOR,
        }

        def publish() -> None:
            for bus, metrics in tell.items():
                bus.publish(bus.keys.metrics(bus.role, bus.id), metrics)

        for number in range(2):
            with recorder(hub, tmp_path) as process, every(0.2, publish):
                listener = Listener(actor)
                listener.wait_for(lambda metrics: metrics.episodes == 0)
                played = rollout(f"failed{number}", number)
                failed = replace(played.episode, outcome=TOUCHED)
                actor.deliver(actor.keys.rollout("actor"), replace(played, episode=failed))
                listener.wait_for(lambda metrics: metrics.episodes == 1)
                assert stop(process) == 0
    past = read_history(history_file(folder))
    assert past.damaged == 0
    told = [sample for sample in past.samples if sample.learner and sample.actors]
    assert told[-1].learner is not None
    assert told[-1].learner.training == "t-1"
    assert epoch in told[-1].learner.epochs
    assert told[-1].actors is not None
    assert told[-1].actors.steps_per_s == 81.25
    scores = {(s.suite, s.version): s.strict for sample in past.samples for s in sample.scores}
    assert scores == {("unlearned", 2): 3, ("unlearned", 3): 44}
    found = EventAccumulator(str(folder / "tensorboard"))
    found.Reload()
    tags = found.Tags()
    assert {"loss/coupled", "rates/steps_per_s", "success_unlearned/strict"} <= {*tags["scalars"]}
    assert len(tags["histograms"]) == len(checkpoint_from_bytes(policy.weights, "").tensors)
    assert {event.step for event in found.Histograms(tags["histograms"][0])} == {3}
    assert found.Images("failure/unlearned")[0].width == 192
