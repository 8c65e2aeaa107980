"""The readings of success in Experiment II."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from actors.simulator import Pose, StepReport
from actors.tasks.experiment2.setting import Setting
from actors.tasks.registry import make_task
from proto.config import TaskConfig
from proto.episode import NO_FAILURE
from sim_assets.hand import CLOSED_DEG, GRASP_AXIS, GRASP_CENTRE_M, OPEN_DEG
from sim_assets.icub import EYE, HAND

TASK = make_task(TaskConfig(name="experiment2"))
SITUATION = {
    "indicated_x_m": "-0.15",
    "indicated_kind": "standing",
    "indicated_y_m": 0.25,
    "indicated_yaw_deg": 10.0,
    "other_kind": "laying",
    "other_y_m": 0.26,
    "other_yaw_deg": -5.0,
    "subject": "0",
    "take": "0",
}
SETTING = Setting.of(SITUATION)


def moved_pose(pose, offset=(0.0, 0.0, 0.0), tilt_deg=0.0):
    turn = Rotation.from_quat(np.roll(pose.quaternion, -1))
    turn = Rotation.from_euler("x", tilt_deg, degrees=True) * turn
    place = np.add(pose.position_m, offset)
    return Pose(tuple(place), tuple(np.roll(turn.as_quat(), 1)))


def hand_at(pose, hand_yaw=0.0, along=0.0, across=0.0):
    """Return the pose of a hand that grasps a box exactly, displaced (m, degrees)."""
    turn = Rotation.from_quat(np.roll(pose.quaternion, -1))
    to_axis = Rotation.align_vectors(
        [[1, 0, 0], [0, 0, -1]], [GRASP_AXIS, np.cross(GRASP_AXIS, [0, -1, 0])]
    )[0]
    hand = Rotation.from_euler("z", np.deg2rad(hand_yaw)) * turn * to_axis
    centre = pose.position_m + turn.apply([across, along, 0.0])
    return Pose(tuple(centre - hand.apply(GRASP_CENTRE_M)), tuple(np.roll(hand.as_quat(), 1)))


def eye_towards(place, aside_deg=0.0):
    """Return the pose of an eye whose optical axis, x, misses a place by an angle."""
    eye = np.array([-0.03, 0.02, 0.5])
    to_place = Rotation.align_vectors([np.subtract(place, eye)], [[1.0, 0.0, 0.0]])[0]
    turn = to_place * Rotation.from_euler("z", aside_deg, degrees=True)
    return Pose(tuple(eye), tuple(turn.as_quat(scalar_first=True)))


def bodies(
    *,
    indicated=(0.0, 0.0, 0.0),
    other=(0.0, 0.0, 0.0),
    tilt=0.0,
    at="indicated",
    seen="indicated",
    aside_deg=0.0,
    **hand,
):
    placed = {
        "indicated_object": moved_pose(SETTING.indicated.pose, indicated, tilt),
        "other_object": moved_pose(SETTING.other.pose, other),
    }
    return {
        **placed,
        HAND: hand_at(placed[f"{at}_object"], **hand),
        EYE: eye_towards(placed[f"{seen}_object"].position_m, aside_deg),
    }


def judged(before=None, after=None, *, closed=True):
    """An episode: 60 steps with the hand open, 30 closed, 10 lifted."""
    judge = TASK.judge(SITUATION)
    lifted = bodies(indicated=(0.0, 0.0, 0.1)) if after is None else after
    for step in range(100):
        motors = CLOSED_DEG if closed and step >= 60 else OPEN_DEG
        joints = np.concatenate([np.zeros(9), motors])
        now = (bodies() if before is None else before) if step < 90 else lifted
        judge.watch(StepReport(frozenset()), joints, now)
    return judge.outcome()


def readings(outcome):
    return (outcome.lenient, outcome.strict, outcome.precise)


def test_a_correct_grasp_is_precise():
    outcome = judged()
    assert readings(outcome) == (True, True, True)
    assert outcome.reason == NO_FAILURE
    assert outcome.value("closed_at") == 60
    assert outcome.value("lifted_m") == pytest.approx(0.1)
    assert outcome.value("yaw_error_deg") == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(
    "hand", [{"hand_yaw": 9.0}, {"hand_yaw": -9.0}, {"along": 0.017}, {"across": -0.012}]
)
def test_a_wrongly_placed_hand_is_strict_but_imprecise(hand):
    outcome = judged(bodies(**hand))
    assert readings(outcome) == (True, True, False)
    assert outcome.reason == "imprecise"


@pytest.mark.parametrize(
    ("before", "reason"),
    [
        ({"other": (0.006, 0.0, 0.0)}, "other_moved"),
        ({"tilt": 20.0}, "toppled"),
        ({"indicated": (0.0, 0.012, 0.0)}, "moved_object"),
        ({"at": "other"}, "wrong_object"),
    ],
)
def test_failures_before_the_hand_closed_are_lenient_only(before, reason):
    outcome = judged(bodies(**before))
    assert readings(outcome) == (True, False, False)
    assert outcome.reason == reason


def test_lifting_the_other_object_is_a_failure():
    outcome = judged(after=bodies(other=(0.0, 0.0, 0.1)))
    assert readings(outcome) == (False, False, False)
    assert outcome.reason == "wrong_object"
    assert outcome.value("other_lifted_m") == pytest.approx(0.1)
    both = bodies(indicated=(0.0, 0.0, 0.1), other=(0.0, 0.0, 0.1))
    assert readings(judged(after=both)) == (True, False, False)


def test_knocking_over_the_other_object_while_lifting_is_a_failure():
    outcome = judged(after=bodies(indicated=(0.0, 0.0, 0.1), other=(0.03, 0.0, -0.02)))
    assert outcome.reason == "other_moved"
    assert outcome.value("other_moved_mm") == pytest.approx(np.hypot(30.0, 20.0))


def test_an_object_that_is_not_lifted_or_not_held_fails():
    assert judged(after=bodies(indicated=(0.0, 0.0, 0.04))).reason == "not_lifted"
    judge = TASK.judge(SITUATION)
    for step in range(100):
        motors = CLOSED_DEG if step >= 60 else OPEN_DEG
        height = 0.1 if step == 99 else 0.0
        joints = np.concatenate([np.zeros(9), motors])
        judge.watch(StepReport(frozenset()), joints, bodies(indicated=(0.0, 0.0, height)))
    assert readings(judge.outcome()) == (True, False, False)
    assert judge.outcome().reason == "not_lifted"


def test_the_gaze_tells_which_object_is_attended():
    right = judged(bodies(aside_deg=3.0))
    assert right.value("gaze_deg") == pytest.approx(3.0, abs=0.01)
    assert right.value("other_gaze_deg") > 20
    wrong = judged(bodies(seen="other"))
    assert wrong.value("other_gaze_deg") == pytest.approx(0.0, abs=0.01)
    assert wrong.value("gaze_deg") > 20


def test_a_hand_that_never_closes_fails():
    outcome = judged(closed=False)
    assert outcome.reason == "never_closed"
    assert outcome.value("closed_at") == -1
    assert not outcome.strict


def test_figures_know_every_reason():
    reasons = {
        NO_FAILURE, "imprecise", "not_lifted", "never_closed", "moved_object", "toppled",
        "other_moved", "wrong_object",
    }  # fmt: skip
    assert set(TASK.figure_words.reasons) == reasons
    outcome = judged(bodies(hand_yaw=5.0, along=0.004, across=0.002))
    errors = {e.name: e.measure(outcome, SITUATION) for e in TASK.figure_words.errors}
    turn = np.deg2rad(10.0)
    assert errors["position_mm"] == pytest.approx(4 * np.cos(turn) - 2 * np.sin(turn), abs=0.1)
    assert TASK.figure_words.in_place(outcome)
    assert not TASK.figure_words.in_place(judged(bodies(at="other")))
