"""A person's commands without a browser: steps, undo, and what is recorded of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from actors.hand_control import FamiliarPostures
from actors.player import play
from actors.policies.by_name import make_policy
from actors.simulator import Simulator, make_simulator
from actors.tasks.contract import Task
from actors.tasks.registry import make_task
from proto.acceptance import misfit
from proto.body import ACTION_SIZE, ARM, FOCUS, GRASP
from proto.config import Config, SimulatorConfig
from proto.episode import Kind
from proto.errors import UserError
from services.by_hand.demonstration import (
    Command,
    Demonstration,
    Focus,
    Grasp,
    LetAct,
    Look,
    MoveHand,
    NextPhase,
    Reach,
)
from services.by_hand.policy import ShownByHand
from services.by_hand.resampling import resample

TURNED = 23
"""A tutored case whose object is turned by 22.5 degrees, with all else in the middle."""
CONFIG = Config(simulator=SimulatorConfig(backend="mujoco", render=False))


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task(CONFIG.task)


@pytest.fixture(scope="module")
def simulator() -> Iterator[Simulator]:
    made = make_simulator(CONFIG.simulator)
    yield made
    made.close()


@pytest.fixture(scope="module")
def familiar(task: Task) -> FamiliarPostures:
    return FamiliarPostures.of_tutor(task)


@pytest.fixture
def shown(simulator: Simulator, task: Task, familiar: FamiliarPostures) -> Demonstration:
    return Demonstration(simulator, task, task.tutored()[0], familiar)


def obey(shown: Demonstration, *commands: Command) -> int:
    """Obey commands; how many control steps they took."""
    return sum(1 for command in commands for _ in shown.obey(command))


def test_the_hand_goes_where_it_is_told(shown: Demonstration) -> None:
    before = shown.hand.centre_m
    steps = obey(shown, *[MoveHand((0.0, 0.0, 0.02))] * 3)
    assert steps >= 3
    assert shown.hand.centre_m - before == pytest.approx([0.0, 0.0, 0.06], abs=0.005)
    before, yaw = shown.hand.centre_m, shown.hand.yaw_deg
    obey(shown, MoveHand((0.0, 0.0, 0.0), 10.0))
    assert shown.hand.yaw_deg - yaw == pytest.approx(10.0, abs=2.5)
    assert shown.hand.centre_m == pytest.approx(before, abs=0.005)


def test_a_click_moves_gaze_and_hand_to_what_is_seen(shown: Demonstration) -> None:
    obey(shown, Look("outside", 0.5, 0.75))
    obey(shown, MoveHand((0.0, 0.0, 0.05)))
    height = shown.hand.centre_m[2]
    obey(shown, Reach("eye", 0.5, 0.5))
    assert shown.hand.centre_m[2] == pytest.approx(height, abs=0.03)
    with pytest.raises(UserError, match="nothing at this place"):
        obey(shown, Reach("outside", 0.0, 0.0))


def test_undo_brings_the_robot_back(shown: Demonstration, simulator: Simulator) -> None:
    obey(shown, MoveHand((0.0, 0.0, 0.02)), NextPhase(), Focus(3.0))
    steps, joints = shown.steps, simulator.joints_deg()
    obey(shown, Grasp(2.0), NextPhase())
    assert (shown.phase, shown.action[GRASP]) == (2, 3.0)
    shown.undo()
    assert (shown.phase, shown.steps) == (1, steps + 2)
    shown.undo()
    assert shown.steps == steps
    assert np.array_equal(simulator.joints_deg(), joints)
    shown.restart()
    assert (shown.phase, shown.steps, shown.can_undo) == (0, 0, False)


def test_a_stopped_robot_stays_where_it_is(shown: Demonstration) -> None:
    moving = shown.obey(MoveHand((0.0, 0.0, 0.05)))
    next(moving)
    moving.close()
    here = shown.hand.centre_m
    obey(shown, MoveHand((0.0, 0.0, 0.004)))
    assert shown.hand.centre_m[2] - here[2] == pytest.approx(0.004, abs=0.002)


def test_a_demonstration_is_an_episode_of_the_task(
    shown: Demonstration, simulator: Simulator, task: Task
) -> None:
    obey(shown, MoveHand((0.0, 0.0, 0.02)))
    with pytest.raises(UserError, match="'lift'"):
        shown.resampled()
    obey(shown, *[NextPhase()] * 7)
    with pytest.raises(UserError, match="last phase"):
        obey(shown, NextPhase())
    policy = ShownByHand(shown.resampled(), 0)
    episode = play(
        simulator, task, policy, shown.situation, seed=0, kind=Kind.TUTORING, actor="by-hand"
    )
    assert misfit(episode, task, simulator.control_period_s) == ""
    assert episode.policy == "by-hand"
    assert episode.actions[-1, ARM] == pytest.approx(shown.action[ARM], abs=1e-4)


def test_a_policy_goes_on_from_where_it_was_corrected(
    simulator: Simulator, task: Task, familiar: FamiliarPostures
) -> None:
    """Here one that repeats one sequence, and grasps an object that is turned imprecisely."""
    situation, replay = task.tutored()[TURNED], make_policy("replay", task)
    alone = play(simulator, task, replay, situation, seed=0, kind=Kind.TRIAL)
    assert alone.outcome.reason == "imprecise"
    shown = Demonstration(simulator, task, situation, familiar, replay)
    acting = shown.obey(LetAct())
    for _ in range(72):  # when the hand is above the object
        next(acting)
    acting.close()
    assert (shown.phase, shown.can_act, shown.corrected) == (5, True, False)
    obey(shown, *[MoveHand((0.0, 0.0, 0.0), -10.0)] * 2, LetAct())
    assert (shown.phase, shown.can_act, shown.corrected) == (7, False, True)
    actions, joints = shown.resampled(), simulator.joints_deg()
    policy = ShownByHand(actions, replay.version)
    corrected = play(simulator, task, policy, situation, seed=0, kind=Kind.CORRECTION)
    assert corrected.outcome.precise
    shown.restore()
    shown.undo()
    assert (shown.phase, shown.can_act) == (5, True)
    obey(shown, LetAct())
    assert np.array_equal(simulator.joints_deg(), joints)
    assert np.array_equal(shown.resampled(), actions)


def test_what_a_policy_does_alone_is_no_correction(
    simulator: Simulator, task: Task, familiar: FamiliarPostures
) -> None:
    shown = Demonstration(
        simulator, task, task.tutored()[TURNED], familiar, make_policy("replay", task)
    )
    obey(shown, LetAct())
    with pytest.raises(UserError, match="nothing was corrected"):
        shown.resampled()
    with pytest.raises(UserError, match="no policy acts"):
        obey(shown, LetAct())
    shown.undo()
    assert (shown.steps, shown.can_act) == (0, True)
    obey(shown, NextPhase())
    with pytest.raises(UserError, match="no policy acts"):
        obey(shown, LetAct())
    shown.undo()
    assert shown.can_act


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 3)), max_size=12))
def test_a_phase_ends_where_the_person_ended_it(moves: list[tuple[int, int]]) -> None:
    moves = sorted(moves, key=lambda move: move[0])
    start = np.zeros(ACTION_SIZE)
    actions = np.empty((len(moves), ACTION_SIZE))
    for row, (_, seed) in enumerate(moves):
        actions[row] = np.random.default_rng(seed).normal(size=ACTION_SIZE)
    phases = [phase for phase, _ in moves]
    durations = (5, 1, 8)
    rows = resample(actions, phases, durations, start)
    assert rows.shape == (14, ACTION_SIZE)
    for phase, end in enumerate(np.cumsum(durations)):
        done = [row for row, (of, _) in enumerate(moves) if of <= phase]
        expected = actions[done[-1]] if done else start
        assert rows[end - 1] == pytest.approx(expected)


def test_waiting_leaves_no_trace() -> None:
    start = np.zeros(ACTION_SIZE)
    goal = start.copy()
    goal[[FOCUS, GRASP]] = 3.0
    quick = resample(np.array([goal]), [0], [10], start)
    slow = resample(np.array([start, start, goal, goal]), [0] * 4, [10], start)
    assert quick == pytest.approx(slow)
