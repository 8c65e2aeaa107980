"""A guided policy acts within a range around the tutor's plan, which is the target."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from actors.player import play
from actors.policies.guided import FOCUS_SLACK, GRASP_SLACK, GuidedPolicy
from actors.policies.planned import PlannedPolicy, make_tutor
from actors.simulator import make_simulator
from actors.tasks.experiment1.plan import plan
from actors.tasks.registry import make_task
from proto.body import FOCUS, GRASP
from proto.config import SimulatorConfig, TaskConfig
from proto.episode import Episode, Image, Kind

TASK = make_task(TaskConfig())
SITUATION = {"obstacle_x_m": -0.24, "object_y_m": 0.28, "object_yaw_deg": 40.0}


class Shifted(PlannedPolicy):
    """Acts like the tutor, with a constant added to all actions."""

    version = 7

    def __init__(self, by: float) -> None:
        super().__init__("shifted", TASK, lambda situation: situation)
        self._by = by

    def step(self, image: Image) -> NDArray[np.float64]:
        return super().step(image) + self._by


def guided(policy: PlannedPolicy, guidance_deg: float) -> Episode:
    tutor = make_tutor(TASK)
    simulator = make_simulator(SimulatorConfig(render=False))
    try:
        given = GuidedPolicy(policy, tutor, guidance_deg)
        return play(simulator, TASK, given, SITUATION, seed=1, kind=Kind.CORRECTION)
    finally:
        simulator.close()


def test_small_errors_are_kept_and_large_errors_are_clipped() -> None:
    meant = plan(SITUATION)
    for by, guidance_deg in ((0.5, 5.0), (-7.0, 5.0), (7.0, 0.0)):
        policy = GuidedPolicy(Shifted(by), make_tutor(TASK), guidance_deg)
        policy.begin(SITUATION, 0)
        off = [policy.step(np.zeros((48, 64), np.uint8)) - step for step in meant]
        assert policy.version == 7
        slack = np.full(11, guidance_deg)
        slack[GRASP], slack[FOCUS] = GRASP_SLACK, FOCUS_SLACK
        np.testing.assert_allclose(off, np.tile(np.clip(by, -slack, slack), (len(meant), 1)))


def test_a_blind_policy_succeeds_under_guidance() -> None:
    # Without guidance its hand has the wrong yaw and pushes the object.
    blind = PlannedPolicy("yaw-blind", TASK, TASK.baselines["yaw-blind"])
    episode = guided(blind, guidance_deg=2.0)
    assert episode.outcome.strict, episode.outcome
    assert (episode.kind, episode.policy, episode.policy_version) == (Kind.CORRECTION, "guided", 0)
    np.testing.assert_allclose(episode.targets, plan(SITUATION), atol=1e-4)
    off = np.abs(episode.actions - episode.targets).max(0)
    assert off.max() <= 2.0 + 1e-4
    assert off[:9].max() > 1.9, "it differs from the plan as far as the guidance allows"
