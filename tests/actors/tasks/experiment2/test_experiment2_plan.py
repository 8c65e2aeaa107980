"""The tutor's plan of Experiment II: smooth, clear of the other object, within the limits."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.kinematics import Arm, ClearanceBox, Gaze
from actors.tasks.experiment2.fitting import FamilyFitter
from actors.tasks.experiment2.plan import plan
from actors.tasks.experiment2.postures import FAMILIES, POSTURES, load_key_postures
from actors.tasks.experiment2.setting import Setting
from actors.tasks.experiment2.world import (
    SCREEN_CENTRE_M,
    START,
    SUBTASKS,
    TABLE_DROP_M,
    Y_RANGE_M,
    YAW_RANGE_DEG,
)
from actors.tasks.registry import make_task
from proto.body import ACTION_VALUES, ARM, FOCUS, GRASP, NECK
from proto.config import TaskConfig
from sim_assets.hand import OPEN_DEG

TASK = make_task(TaskConfig(name="experiment2"))
ARM_OPEN = Arm(OPEN_DEG, TABLE_DROP_M)
BEGINS = dict(zip(SUBTASKS, np.cumsum([0, *SUBTASKS.values()]), strict=False))
situations = st.integers(0, 2**32 - 1).map(TASK.sample)


def clearance_m(posture_deg, placed):
    box = ClearanceBox(np.array(placed.pose.position_m), np.array(placed.size_m), placed.yaw_rad)
    pose = ARM_OPEN.pose(np.deg2rad(posture_deg))
    return (box.distance(pose.points_m) - ARM_OPEN.radii_m).min()


@given(situations)
@settings(max_examples=50)
def test_plan_stays_within_the_limits_and_moves_smoothly(situation):
    actions = plan(situation)
    assert actions.shape == (148, 11)
    low = [value.minimum for value in ACTION_VALUES]
    high = [value.maximum for value in ACTION_VALUES]
    assert (actions >= low).all()
    assert (actions <= high).all()
    np.testing.assert_allclose(actions[0], START, atol=0.5)
    assert np.abs(np.diff(actions[:, ARM], axis=0)).max() < 12.0


@given(situations)
@settings(max_examples=15)
def test_open_arm_stays_clear_of_both_objects(situation):
    actions, setting = plan(situation), Setting.of(situation)
    reaching = actions[BEGINS["reach above object"] : BEGINS["approach"], ARM]
    approaching = actions[BEGINS["approach"] : BEGINS["grasp"], ARM]
    assert min(clearance_m(posture, setting.indicated) for posture in reaching) > 0.001
    for posture in np.concatenate([reaching, approaching]):
        assert clearance_m(posture, setting.other) > 0.005


@given(situations, st.sampled_from(("indicated_y_m", "indicated_yaw_deg")))
@settings(max_examples=25)
def test_neighbouring_situations_have_neighbouring_plans(situation, name):
    low, high = Y_RANGE_M if name == "indicated_y_m" else YAW_RANGE_DEG
    plans = [plan({**situation, name: value})[:, ARM] for value in np.linspace(low, high, 11)]
    steps = [np.abs(one - other).max() for one, other in itertools.pairwise(plans)]
    assert max(steps) < 8.0


@given(situations)
@settings(max_examples=10)
def test_plan_depends_only_on_the_indicated_object(situation):
    other = {"other_kind": "laying", "other_y_m": 0.25, "other_yaw_deg": 3.0, "take": "11"}
    np.testing.assert_array_equal(plan(situation), plan({**situation, **other}))


def test_plans_are_equal_until_the_head_turns():
    plans = [plan(situation) for situation in TASK.tutored()]
    for actions in plans:
        first = actions[: BEGINS["attend object"]]
        np.testing.assert_array_equal(first, plans[0][: BEGINS["attend object"]])


def test_attention_follows_the_subtasks():
    situation = TASK.sample(3)
    actions = plan(situation)
    screen = Gaze(TABLE_DROP_M).neck_deg(np.array(SCREEN_CENTRE_M))
    np.testing.assert_allclose(actions[:40, NECK] - screen, 0.0, atol=0.1)
    place = np.array(Setting.of(situation).indicated.pose.position_m)
    at_object = Gaze(TABLE_DROP_M).neck_deg(place)
    rest = actions[BEGINS["reach above object"] :, NECK]
    np.testing.assert_allclose(rest - at_object, 0.0, atol=0.1)
    assert (actions[: BEGINS["approach"], FOCUS] == 1.0).all()
    assert (actions[BEGINS["grasp"] :, FOCUS] == 20.0).all()
    assert (actions[: BEGINS["grasp"], GRASP] == 1.0).all()
    assert (actions[BEGINS["lift"] :, GRASP] == 10.0).all()


@pytest.mark.parametrize("family", FAMILIES, ids=" ".join)
@pytest.mark.slow
def test_fitting_gives_the_postures_in_the_repository(family):
    fitted, stored = FamilyFitter(family).fit(), load_key_postures().families[family]
    np.testing.assert_allclose(fitted.passing, stored.passing, atol=0.05)
    for name in POSTURES:
        np.testing.assert_allclose(fitted.at_object[name], stored.at_object[name], atol=0.05)
