"""Every disturbance can be staged; what it does is repeatable, bounded, and judged fairly."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from actors.disturbances.pictures import PICTURE_CHANGES
from actors.disturbances.scenes import SCENE_CHANGES, VARIABLE_CHANGES, object_of, table_of
from actors.disturbances.staging import check_abilities, check_staged, stage
from actors.player import play
from actors.policies.guided import GuidedPolicy
from actors.policies.planned import make_tutor
from actors.simulator import Scene, Simulator, make_simulator
from actors.tasks.contract import Task
from actors.tasks.registry import make_task
from proto.config import Config, SimulatorConfig, TaskConfig
from proto.disturbances import DISTURBANCES
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.situations import situation_of
from proto.suites import Conditions
from proto.variables import number_of, situation_text

FIRST = make_task(TaskConfig())
SECOND = make_task(TaskConfig(name="experiment2"))
TASKS = {task.name: task for task in (FIRST, SECOND)}
PICTURE = np.random.default_rng(3).integers(60, 180, (48, 64), dtype=np.uint8)


def disturbed(name: str, strength: float | None = None) -> Conditions:
    disturbance = DISTURBANCES[name]
    return Conditions(name, 1.0, name, disturbance.usual[1] if strength is None else strength)


def scene_of(name: str, strength: float | None = None, task: Task = FIRST, seed: int = 5) -> Scene:
    return stage(task, task.sample(seed), disturbed(name, strength), seed).scene


@pytest.fixture(scope="module")
def physics() -> Iterator[Simulator]:
    with closing(make_simulator(SimulatorConfig(render=False))) as simulator:
        yield simulator


def played(
    physics: Simulator, name: str, strength: float, *, task: Task = FIRST, seed: int = 5
) -> Episode:
    conditions = disturbed(name, strength)
    tutor = make_tutor(task)
    return play(
        physics, task, tutor, task.sample(seed), seed=seed, kind=Kind.TRIAL, conditions=conditions
    )


def test_every_disturbance_of_the_table_can_be_staged() -> None:
    assert {*PICTURE_CHANGES, *SCENE_CHANGES, *VARIABLE_CHANGES} == set(DISTURBANCES)


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
@pytest.mark.parametrize("name", DISTURBANCES)
def test_a_disturbance_changes_the_episode_and_the_seed_decides_how(task: Task, name: str) -> None:
    situation = task.sample(7)
    plain = stage(task, situation, None, 7)
    first, again = (stage(task, situation, disturbed(name), 7) for _ in range(2))
    assert repr(first.scene) == repr(again.scene)
    pictures = [each.picture(3, PICTURE) for each in (first, again)]
    assert np.array_equal(*pictures)
    assert pictures[0].dtype == np.uint8
    changed_scene = repr(first.scene) != repr(plain.scene)
    assert changed_scene != (name in PICTURE_CHANGES)
    assert changed_scene == np.array_equal(pictures[0], PICTURE)
    if ability := DISTURBANCES[name].ability:
        before = replace(first.scene, **{ability: getattr(plain.scene, ability)})
        assert repr(before) == repr(plain.scene), "nothing else has changed"


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_a_push_and_a_turn_are_over_before_the_hand_comes_down(task: Task) -> None:
    names = list(task.phase_names)
    descent = names.index("reach above object") + 1
    for name, variable in (("pushed", task.pushed_variable), ("turned", task.turned_variable)):
        for seed in range(6):
            before = task.sample(seed)
            staging = stage(task, before, disturbed(name), seed)
            (shove,) = staging.scene.shoves
            assert staging.changed_at == shove.step + 1
            assert names[task.phases[shove.step]] == "reach above object"
            assert shove.step + 10 <= int(np.flatnonzero(task.phases == descent)[0])
            moved = number_of(staging.situation, variable) - number_of(before, variable)
            unit = 1e-3 if name == "pushed" else 1.0
            assert abs(moved) == pytest.approx(DISTURBANCES[name].usual[1] * unit)


def test_a_push_stays_inside_the_range_where_it_can() -> None:
    for seed in range(60):
        staging = stage(FIRST, FIRST.sample(seed), disturbed("pushed"), seed)
        FIRST.check(staging.situation)


def test_stretched_situations_lie_outside_the_ranges_but_inside_the_stretched_ones() -> None:
    conditions = Conditions("beyond", 1.2)
    for task in TASKS.values():
        for seed in range(6):
            situation = situation_of(task, conditions, seed)
            assert situation == situation_of(task, conditions, seed)
            with pytest.raises(UserError, match="lies outside"):
                task.check(situation)
            check_staged(task, situation, conditions)
    assert situation_of(FIRST, None, 3) == FIRST.sample(3)
    far = {**FIRST.sample(3), "object_y_m": 0.4}
    with pytest.raises(UserError, match=r"object_y_m = 0\.4 lies outside"):
        check_staged(FIRST, far, conditions)


def test_scenes_change_by_the_strength() -> None:
    plain = FIRST.scene(FIRST.sample(5))
    thing = object_of(plain)
    assert object_of(scene_of("larger", 10.0)).size_m == pytest.approx((0.0308, 0.11, 0.07))
    assert object_of(scene_of("heavier", 50.0)).mass_kg == pytest.approx(0.15)
    assert object_of(scene_of("slippery", 20.0)).friction == pytest.approx(0.8 * thing.friction)
    shades = {table_of(scene_of("table-shade", 20.0, seed=seed)).colour[0] for seed in range(20)}
    assert sorted(shades) == pytest.approx([0.8 * 0.75, 1.2 * 0.75])
    w, *axis = scene_of("camera-turned", 2.0).eye_turn
    assert 2 * np.rad2deg(np.arccos(w)) == pytest.approx(2.0)
    assert np.linalg.norm([w, *axis]) == pytest.approx(1.0)
    assert list(scene_of("joint-friction", 3.0).damping.values()) == [3.0]
    (knock,) = scene_of("knocked", 20.0).knocks
    assert abs(knock.torque_nm) == 20.0


def test_pictures_change_by_the_strength() -> None:
    def seen(name: str, strength: float, step: int = 0) -> np.ndarray:
        staging = stage(FIRST, FIRST.sample(5), disturbed(name, strength), 5)
        return staging.picture(step, PICTURE).astype(float)

    plain = PICTURE.astype(float)
    assert seen("brighter", 20.0) == pytest.approx(1.2 * plain, abs=0.5)
    assert seen("darker", 20.0) == pytest.approx(0.8 * plain, abs=0.5)
    assert seen("brighter", 100.0).max() == 255.0
    assert (seen("noisy", 10.0) - plain).std() == pytest.approx(10.0, rel=0.1)
    assert not np.array_equal(seen("noisy", 10.0, step=1), seen("noisy", 10.0))
    assert seen("blurred", 1.5).std() < 0.5 * plain.std()
    assert seen("blurred", 1.5).mean() == pytest.approx(plain.mean(), abs=1.0)
    hidden = seen("occluded", 10.0) == 0.0
    assert hidden.sum() == 100
    rows, columns = np.nonzero(hidden)
    assert (np.ptp(rows), np.ptp(columns)) == (9, 9)
    assert np.array_equal(seen("occluded", 10.0, step=9) == 0.0, hidden), "it stays where it is"


def test_the_tutor_follows_an_object_that_is_pushed_or_turned(physics: Simulator) -> None:
    """The disturbance is not counted as a shove by the robot, and lifting it is success."""
    for name, strength in (("pushed", 25.0), ("turned", 18.0)):
        episode = played(physics, name, strength)
        assert episode.outcome.precise, episode.outcome
        assert episode.outcome.value("moved_mm") < 5.0
        assert episode.conditions == disturbed(name, strength)
        assert situation_text(episode.situation) == situation_text(FIRST.sample(5))
        place = episode.body_poses[:, episode.body_names.index("object")]
        before_descent = int(np.flatnonzero(episode.phases == 5)[0])
        moved_mm = 1e3 * np.abs(place[before_descent, :3] - place[0, :3])
        assert moved_mm == pytest.approx([0, 25 if name == "pushed" else 0, 0], abs=1.0)


def test_a_policy_that_ignores_the_push_fails(physics: Simulator) -> None:
    class Ignorant:
        name, version, looks, target, outputs = "ignorant", 0, False, None, None

        def begin(self, situation: object, seed: int) -> None:  # noqa: ARG002
            self._plan, self._step = FIRST.plan(situation), -1

        def step(self, image: object) -> np.ndarray:  # noqa: ARG002
            self._step += 1
            return self._plan[self._step]

    conditions, situation = disturbed("turned", 20.0), FIRST.sample(5)
    episode = play(
        physics, FIRST, Ignorant(), situation, seed=5, kind=Kind.TRIAL, conditions=conditions
    )
    assert not episode.outcome.precise


def test_guidance_leads_to_where_the_object_was_pushed(physics: Simulator) -> None:
    """A correction under a disturbance: the targets are the tutor's plan for what is true then."""
    tutor = make_tutor(FIRST)
    guided = GuidedPolicy(make_tutor(FIRST), tutor, 5.0)
    conditions = disturbed("pushed", 30.0)
    situation = FIRST.sample(5)
    episode = play(
        physics, FIRST, guided, situation, seed=5, kind=Kind.CORRECTION, conditions=conditions
    )
    after = stage(FIRST, situation, conditions, 5).situation
    assert episode.targets[-30:] == pytest.approx(FIRST.plan(after)[-30:], abs=1e-4)
    assert episode.targets[:40] == pytest.approx(FIRST.plan(situation)[:40], abs=1e-4)


def test_an_episode_without_conditions_is_the_same_as_ever(physics: Simulator) -> None:
    situation = FIRST.sample(5)
    episodes = [
        play(
            physics, FIRST, make_tutor(FIRST), situation, seed=5, kind=Kind.TRIAL, conditions=given
        )
        for given in (None, Conditions("mine"))
    ]
    assert np.array_equal(episodes[0].body_poses, episodes[1].body_poses)
    assert episodes[0].outcome == episodes[1].outcome


def test_a_simulator_that_lacks_an_ability_is_not_given_the_disturbance(
    physics: Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(physics), "abilities", frozenset())
    with pytest.raises(UserError, match=r"cannot play the disturbance 'pushed'.*Scene\.shoves"):
        played(physics, "pushed", 20.0)
    check_abilities(physics, disturbed("noisy"))
    check_abilities(physics, None)


def test_a_task_that_names_no_variable_cannot_be_pushed() -> None:
    class Plain(type(FIRST)):
        pushed_variable = ""

    task = Plain(TaskConfig())
    with pytest.raises(UserError, match="names no pushed_variable"):
        stage(task, task.sample(1), disturbed("pushed"), 1)


def test_suites_of_the_configuration_can_be_staged_for_both_tasks() -> None:
    config = Config.model_validate({"evaluator": {"suites": ["unlearned", "beyond", "disturbed"]}})
    for task in TASKS.values():
        for suite in config.suites:
            for seed in suite.test_seeds[:8]:
                conditions = suite.conditions(seed)
                stage(task, situation_of(task, conditions, seed), conditions, seed)
