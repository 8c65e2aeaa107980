"""Whole episodes in real physics, played by the tutor and the baselines."""

import dataclasses

import numpy as np
import pytest

from actors.player import play
from actors.policies.by_name import make_policy
from actors.policies.planned import make_tutor
from actors.simulator import Crop, make_simulator
from actors.tasks.registry import make_task
from proto.body import ARM, FOCUS, GRASP, NECK
from proto.config import SimulatorConfig, TaskConfig, TutorConfig
from proto.episode import Kind
from proto.errors import UserError

TASK = make_task(TaskConfig())
REACHING = make_task(TaskConfig(name="reaching"))


@pytest.fixture(scope="module")
def physics():
    simulator = make_simulator(SimulatorConfig(render=False))
    yield simulator
    simulator.close()


def outcome(simulator, policy, situation, seed=0):
    return play(
        simulator, TASK, make_policy(policy, TASK), situation, seed=seed, kind=Kind.TRIAL
    ).outcome


@pytest.mark.parametrize("corner", range(8))
def test_tutor_is_precise_at_every_corner_of_the_ranges(physics, corner):
    result = outcome(physics, "tutor", TASK.corners()[corner])
    assert result.precise, result


def test_tutor_is_precise_inside_the_ranges(physics):
    results = [outcome(physics, "tutor", TASK.sample(seed)) for seed in range(20)]
    assert all(result.precise for result in results)


def test_a_baseline_that_ignores_yaw_pushes_a_turned_object(physics):
    for yaw in (-40.0, 40.0):
        situation = {"obstacle_x_m": -0.27, "object_y_m": 0.25, "object_yaw_deg": yaw}
        assert not outcome(physics, "yaw-blind", situation).strict
        assert outcome(physics, "tutor", situation).strict


@pytest.mark.parametrize("obstacle_x_m", [-0.32, -0.22])
def test_a_baseline_that_ignores_the_obstacle_touches_it(physics, obstacle_x_m):
    situation = {"obstacle_x_m": obstacle_x_m, "object_y_m": 0.25, "object_yaw_deg": 0.0}
    assert outcome(physics, "obstacle-blind", situation).reason == "touched_obstacle"


def test_replay_succeeds_only_in_the_recorded_situation(physics):
    recorded = {"obstacle_x_m": -0.27, "object_y_m": 0.25, "object_yaw_deg": 0.0}
    assert outcome(physics, "replay", recorded).precise
    assert not outcome(physics, "replay", {**recorded, "object_yaw_deg": 45.0}).strict


def test_lookup_is_the_tutor_on_the_grid(physics):
    case = TASK.tutored()[17]
    assert outcome(physics, "lookup", case) == outcome(physics, "tutor", case)


@pytest.mark.parametrize("name", ["tutor", "lookup"])
def test_without_an_obstacle_the_tutor_moves_as_over_the_middle_obstacle(physics, name):
    situation = {"object_y_m": 0.25, "object_yaw_deg": 22.5}
    over = {**situation, "obstacle_x_m": -0.27}
    free, blocked = (
        play(physics, task, make_policy(name, task), where, seed=0, kind=Kind.TUTORING)
        for task, where in ((REACHING, situation), (TASK, over))
    )
    assert free.outcome.precise
    assert free.situation == situation
    np.testing.assert_array_equal(free.actions, blocked.actions)


def test_lifting_needs_friction(monkeypatch):
    class Slippery(type(TASK)):
        def scene(self, situation):
            scene = super().scene(situation)
            boxes = tuple(dataclasses.replace(box, friction=0.02) for box in scene.boxes)
            return dataclasses.replace(scene, boxes=boxes)

    monkeypatch.setattr("actors.backends.robot.SKIN_FRICTION", 0.02)
    simulator = make_simulator(SimulatorConfig(render=False))
    policy = make_tutor(TASK)
    episode = play(
        simulator, Slippery(TaskConfig()), policy, TASK.sample(1), seed=0, kind=Kind.TRIAL
    )
    simulator.close()
    assert not episode.outcome.lenient


def test_the_same_episode_can_be_played_again_bit_by_bit(physics):
    tutor = make_tutor(TASK, TutorConfig())
    play_it = lambda seed: play(  # noqa: E731
        physics, TASK, tutor, TASK.tutored()[5], seed=seed, kind=Kind.TUTORING
    )
    first, other, again = play_it(3), play_it(4), play_it(3)
    np.testing.assert_array_equal(first.body_poses, again.body_poses)
    np.testing.assert_array_equal(first.joints_deg, again.joints_deg)
    assert first.outcome == again.outcome
    assert first.id != again.id
    assert np.abs(first.joints_deg - other.joints_deg).max() > 0.1


def test_noise_is_in_the_actions_and_the_clean_plan_stays_the_target(physics):
    clean = play(
        physics, TASK, make_tutor(TASK), TASK.tutored()[5],
        seed=0, kind=Kind.TUTORING,
    )  # fmt: skip
    noisy = play(
        physics, TASK, make_tutor(TASK, TutorConfig()), TASK.tutored()[5],
        seed=1, kind=Kind.TUTORING,
    )  # fmt: skip
    np.testing.assert_array_equal(clean.actions, clean.targets)
    np.testing.assert_array_equal(noisy.targets, clean.targets)
    assert np.abs(noisy.actions - noisy.targets).max() > 0.5


def test_an_unknown_policy_is_refused_with_a_list_of_policies():
    with pytest.raises(UserError, match=r"tutor, replay, yaw-blind, obstacle-blind, lookup"):
        make_policy("tutr", TASK)


def test_an_unknown_backend_is_refused_with_a_list_of_backends():
    for name in ("sapiens", "no.such.module:Simulator", "actors.player:Nothing"):
        with pytest.raises(UserError, match="sapien"):
            make_simulator(SimulatorConfig(backend=name))


def test_with_attention_fixed_the_tutor_neither_turns_its_head_nor_focuses(physics):
    fixed, case = make_task(TaskConfig(attention="fixed")), TASK.tutored()[3]
    noisy = make_tutor(TASK, TutorConfig())
    still = play(physics, fixed, noisy, case, seed=3001, kind=Kind.TUTORING)
    moving = play(physics, TASK, noisy, case, seed=3001, kind=Kind.TUTORING)
    held, free = np.r_[NECK, FOCUS], np.r_[ARM, GRASP]
    for values in (still.actions, still.targets):
        assert (values[:, held] == TASK.start[held]).all()
    assert np.ptp(moving.targets[:, held], axis=0).min() > 1
    np.testing.assert_array_equal(still.actions[:, free], moving.actions[:, free])
    np.testing.assert_array_equal(still.targets[:, free], moving.targets[:, free])
    assert np.ptp(still.joints_deg[:, NECK], axis=0).max() < 0.1


class SeenEnoughError(Exception):
    pass


def test_pictures_for_viewers_change_nothing():
    """Neither what the eye sees in the next steps nor how the robot moves."""
    simulator = make_simulator(SimulatorConfig())

    def watched(looks_at_step):
        seen = []

        def on_step(live):
            seen.append((live.image, live.joints_deg))
            if live.step == looks_at_step:
                assert simulator.outside_picture(48, 36).shape == (36, 48, 3)
                assert simulator.eye_picture(Crop(), 32, 24).shape == (24, 32, 3)
            if live.step == 24:
                raise SeenEnoughError

        with pytest.raises(SeenEnoughError):
            play(
                simulator,
                TASK,
                make_policy("tutor", TASK),
                TASK.sample(3),
                seed=3,
                kind=Kind.PRACTICE,
                on_step=on_step,
            )
        return seen

    for alone, looked_at in zip(watched(None), watched(20), strict=True):
        assert np.array_equal(alone[0], looked_at[0])
        assert np.array_equal(alone[1], looked_at[1])
    simulator.close()


def test_the_pfc_of_a_policy_can_be_watched(physics):
    heard = []
    for policy in ("tutor", "pretrained:experiment1"):
        play(
            physics,
            TASK,
            make_policy(policy, TASK),
            TASK.sample(3),
            seed=3,
            kind=Kind.PRACTICE,
            on_step=lambda live: heard.append(live.pfc),
        )
    tutor, network = heard[: len(TASK.phases)], heard[len(TASK.phases) :]
    assert set(tutor) == {None}
    assert np.ptp(np.stack(network), axis=0).shape == (20,)
    assert np.ptp(np.stack(network), axis=0).max() > 0.1
