"""A run with a real hub and real sessions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from ports import free_endpoint
from run_metrics import ACTOR, EVALUATOR, LEARNER
from staged_run import StagedRun, record

from proto.bus import open_hub
from proto.config import Config, HubConfig, RunConfig
from proto.episode import NO_FAILURE, Episode, Kind, Outcome

FAILED = Outcome(False, False, False, "not_lifted", {})
PRECISE = Outcome(True, True, True, NO_FAILURE, {})


@pytest.fixture
def episodes(make_episode: Callable[..., Episode]) -> list[Episode]:
    """A tutored sequence, a failure and a success."""
    rollout = {"policy": "staged", "policy_version": 3, "kind": Kind.TRIAL, "started_s": 1.7e9}
    return [
        make_episode(id="tutored", started_s=1.7e9),
        make_episode(id="failed", outcome=FAILED, **rollout),
        make_episode(id="succeeded", outcome=PRECISE, **rollout),
    ]


@pytest.fixture
def staged(tmp_path: Path, episodes: list[Episode]) -> Iterator[StagedRun]:
    """A run with a learner, an evaluator, an actor and three recordings."""
    hub = HubConfig(endpoint=free_endpoint())
    config = Config(run=RunConfig(name="staged", folder=tmp_path), hub=hub)
    record(config.run_folder / "tutoring", episodes[0])
    for episode in episodes[1:]:
        record(config.run_folder / "rollouts", episode)
    with open_hub(hub, "staged", "hub"):
        run = StagedRun(config)
        try:
            for metrics in (LEARNER, EVALUATOR, ACTOR):
                run.join(metrics)
            yield run
        finally:
            run.close()
