"""Experiment I: its situations and its readings of success."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from actors.simulator import ROBOT, Pose, StepReport
from actors.tasks.experiment1.world import GRID, SUBTASKS, object_pose
from actors.tasks.registry import make_task
from proto.config import TaskConfig
from proto.episode import NO_FAILURE
from proto.errors import UserError
from sim_assets.hand import CLOSED_DEG, GRASP_AXIS, GRASP_CENTRE_M, OPEN_DEG
from sim_assets.icub import HAND

TASK = make_task(TaskConfig())
REACHING = make_task(TaskConfig(name="reaching"))
SITUATION = {"obstacle_x_m": -0.27, "object_y_m": 0.25, "object_yaw_deg": 20.0}
NO_TOUCH = StepReport(frozenset())


def test_the_45_tutored_cases_are_those_of_the_paper():
    cases = TASK.tutored()
    assert len(cases) == 45
    assert {case["obstacle_x_m"] for case in cases} == {-0.22, -0.27, -0.32}
    assert {case["object_y_m"] for case in cases} == {0.20, 0.25, 0.30}
    assert {case["object_yaw_deg"] for case in cases} == {-45.0, -22.5, 0.0, 22.5, 45.0}
    assert len({tuple(case.values()) for case in cases}) == 45


def test_reaching_is_the_same_without_an_obstacle():
    cases = REACHING.tutored()
    assert len(cases) == 15
    assert {tuple(case) for case in cases} == {("object_y_m", "object_yaw_deg")}
    with_obstacle = {**cases[7], "obstacle_x_m": -0.27}
    scene, other = REACHING.scene(cases[7]), TASK.scene(with_obstacle)
    assert scene.boxes == tuple(box for box in other.boxes if box.name != "obstacle")
    np.testing.assert_equal(vars(scene.start), vars(other.start))
    assert scene.table_drop_m == other.table_drop_m
    with pytest.raises(UserError, match="reaching: a situation has object_y_m, object_yaw_deg"):
        REACHING.check(with_obstacle)


def test_an_episode_has_eight_subtasks_and_the_papers_length():
    phases = TASK.phases
    assert 110 <= len(phases) <= 140
    assert sorted(set(phases)) == list(range(8))
    assert len(SUBTASKS) == 8
    assert (np.diff(phases) >= 0).all()


@given(st.integers(0, 2**32 - 1))
def test_samples_lie_inside_the_ranges_and_repeat_with_their_seed(seed):
    task = TASK
    situation = task.sample(seed)
    task.check(situation)
    assert situation == task.sample(seed)
    assert tuple(situation) == tuple(GRID)


def test_samples_fill_the_ranges():
    task = TASK
    values = np.array([list(task.sample(seed).values()) for seed in range(400)])
    for column, variable in zip(values.T, task.variables, strict=True):
        ends = (variable.minimum, variable.maximum)
        counts = np.histogram(column, bins=4, range=ends)[0]
        assert counts.min() > 60


@pytest.mark.parametrize(
    ("situation", "part"),
    [
        ({**SITUATION, "object_y_m": 0.31}, "object_y_m = 0.31"),
        ({**SITUATION, "object_yaw_deg": float("nan")}, "object_yaw_deg = nan"),
        ({"object_y_m": 0.25}, "obstacle_x_m"),
    ],
)
def test_an_invalid_situation_is_refused(situation, part):
    with pytest.raises(UserError, match=part):
        TASK.check(situation)


def bodies(*, height=0.0, moved=0.0, turned=0.0, hand_yaw=0.0, along=0.0, across=0.0):
    """Return poses of the object and of a hand that grasps it exactly, both displaced (m, deg)."""
    start = object_pose(SITUATION)
    yaw = Rotation.from_quat(np.roll(start.quaternion, -1)).as_euler("xyz")[2]
    object_turn = Rotation.from_euler("z", yaw + np.deg2rad(turned))
    place = np.add(start.position_m, (moved, 0.0, height))
    # grasp axis along the object's thin side, approach straight down
    to_axis = Rotation.align_vectors(
        [[1, 0, 0], [0, 0, -1]], [GRASP_AXIS, np.cross(GRASP_AXIS, [0, -1, 0])]
    )[0]
    hand = Rotation.from_euler("z", np.deg2rad(hand_yaw)) * object_turn * to_axis
    centre = place + object_turn.apply([across, along, 0.0])
    return {
        "object": Pose(tuple(place), tuple(np.roll(object_turn.as_quat(), 1))),
        HAND: Pose(tuple(centre - hand.apply(GRASP_CENTRE_M)), tuple(np.roll(hand.as_quat(), 1))),
    }


def judged(open_bodies, lifted=0.1, *, closed=True, touch_at=None):
    """Judge an episode: 60 steps with the hand open, 30 closed, 10 lifted."""
    judge = TASK.judge(SITUATION)
    touch = StepReport(frozenset({("obstacle", ROBOT)}))
    for step in range(100):
        motors = CLOSED_DEG if closed and step >= 60 else OPEN_DEG
        joints = np.concatenate([np.zeros(9), motors])
        now = open_bodies if step < 90 else bodies(height=lifted)
        judge.watch(touch if step == touch_at else NO_TOUCH, joints, now)
    return judge.outcome()


def test_a_correct_grasp_is_precise():
    outcome = judged(bodies())
    assert (outcome.lenient, outcome.strict, outcome.precise) == (True, True, True)
    assert outcome.reason == NO_FAILURE
    assert outcome.value("closed_at") == 60
    assert outcome.value("lifted_m") == pytest.approx(0.1)
    assert abs(outcome.value("along_mm")) < 1e-6
    assert abs(outcome.value("across_mm")) < 1e-6
    assert abs(outcome.value("yaw_error_deg")) < 1e-6


@pytest.mark.parametrize("turned_too_far_deg", [-30.0, -8.0, 8.0, 30.0])
def test_the_yaw_error_has_the_sign_of_the_task_frame(turned_too_far_deg):
    """The error is positive if the hand's yaw in the task frame is larger than the object's."""
    flaw = bodies(hand_yaw=-turned_too_far_deg)  # the task frame is left-handed
    assert judged(flaw).value("yaw_error_deg") == pytest.approx(turned_too_far_deg)


@pytest.mark.parametrize(
    ("flaw", "reason"),
    [
        ({"moved": 0.011}, "moved_object"),
        ({"turned": 5.5}, "moved_object"),
        ({"turned": -5.5}, "moved_object"),
    ],
)
def test_an_object_pushed_before_the_hand_closes_is_lenient_only(flaw, reason):
    outcome = judged(bodies(**flaw))
    assert (outcome.lenient, outcome.strict, outcome.precise) == (True, False, False)
    assert outcome.reason == reason


@pytest.mark.parametrize(
    "flaw", [{"hand_yaw": 11.0}, {"hand_yaw": -11.0}, {"along": 0.021}, {"across": -0.011}]
)
def test_a_hand_in_the_wrong_pose_is_strict_but_not_precise(flaw):
    outcome = judged(bodies(**flaw))
    assert (outcome.strict, outcome.precise) == (True, False)
    assert outcome.reason == "imprecise"


@pytest.mark.parametrize(
    "flaw", [{"hand_yaw": 9.0}, {"along": -0.019}, {"across": 0.009}, {"moved": 0.009}]
)
def test_small_flaws_are_forgiven(flaw):
    assert judged(bodies(**flaw)).strict


def test_touching_the_obstacle_once_is_enough_to_fail_strict():
    outcome = judged(bodies(), touch_at=33)
    assert (outcome.lenient, outcome.strict) == (True, False)
    assert outcome.value("obstacle_touched_at") == 33
    assert outcome.reason == "touched_obstacle"


def test_an_object_not_lifted_fails_every_reading():
    outcome = judged(bodies(), lifted=0.049)
    assert (outcome.lenient, outcome.strict, outcome.precise) == (False, False, False)
    assert outcome.reason == "not_lifted"


def test_a_hand_that_never_closed_did_not_grasp():
    assert judged(bodies(), closed=False).reason == "never_closed"


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"name": "experiment9"}, r"task.name: there is no 'experiment9'. Built in are: exp"),
        ({"gestures": "videos"}, "task.gestures: the task experiment1 has no such option"),
    ],
)
def test_an_unknown_task_or_option_is_refused(values, problem):
    with pytest.raises(UserError, match=problem):
        make_task(TaskConfig.model_validate(values))
