"""The tutor's plan: smooth in the situation, clear of the obstacle, within the robot's limits."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.kinematics import Arm, ClearanceBox, Gaze
from actors.tasks.experiment1.fitting import PostureFitter
from actors.tasks.experiment1.plan import plan
from actors.tasks.experiment1.postures import load_key_postures
from actors.tasks.experiment1.world import (
    OBSTACLE_SIZE_M,
    START,
    TABLE_DROP_M,
    object_pose,
    obstacle_pose,
)
from actors.tasks.registry import make_task
from proto.body import ACTION_VALUES, ARM, FOCUS, GRASP, NECK
from proto.config import TaskConfig
from sim_assets.hand import OPEN_DEG

TASK = make_task(TaskConfig())
situations = st.fixed_dictionaries(
    {each.name: st.floats(each.minimum, each.maximum) for each in TASK.variables}
)
ARM_OPEN = Arm(OPEN_DEG, TABLE_DROP_M)


@given(situations)
@settings(max_examples=50)
def test_plan_stays_within_the_limits_and_moves_smoothly(situation):
    actions = plan(situation)
    low = [value.minimum for value in ACTION_VALUES]
    high = [value.maximum for value in ACTION_VALUES]
    assert (actions >= low).all()
    assert (actions <= high).all()
    np.testing.assert_allclose(actions[0], START, atol=0.5)
    assert np.abs(np.diff(actions[:, ARM], axis=0)).max() < 12.0


@given(situations)
@settings(max_examples=25)
def test_open_arm_passes_the_obstacle_closely_but_clear(situation):
    actions = plan(situation)
    box = ClearanceBox(np.array(obstacle_pose(situation).position_m), np.array(OBSTACLE_SIZE_M))
    approach = np.deg2rad(actions[actions[:, GRASP] <= 1.0][:, ARM])
    clearance = min(
        (box.distance(ARM_OPEN.pose(posture).points_m) - ARM_OPEN.radii_m).min()
        for posture in approach
    )
    assert 0.008 < clearance < 0.020


def test_neighbouring_cases_have_neighbouring_plans():
    plans = {tuple(case.values()): plan(case) for case in TASK.tutored()}
    axes = [sorted({key[axis] for key in plans}) for axis in range(3)]
    steps = [
        np.abs(plans[a] - plans[b])[:, ARM].max()
        for a, b in itertools.combinations(plans, 2)
        if sum(abs(axes[k].index(a[k]) - axes[k].index(b[k])) for k in range(3)) == 1
    ]
    assert len(steps) == 45 * 3 - 15 - 15 - 9
    assert max(steps) < 35.0


def test_attention_follows_the_subtasks():
    task = TASK
    situation = task.sample(3)
    actions = plan(situation)
    looking_at_object = actions[task.phases == 4]
    assert np.ptp(looking_at_object[:, NECK], axis=0).max() < 0.1
    assert (actions[task.phases <= 4][:, FOCUS] == 1.0).all()
    assert (actions[task.phases >= 6][:, FOCUS] == 20.0).all()
    assert (actions[task.phases <= 5][:, GRASP] == 1.0).all()
    assert (actions[task.phases == 7][:, GRASP] == 10.0).all()


def test_gaze_follows_the_point():
    gaze = Gaze(TABLE_DROP_M)
    straight = gaze.neck_deg(np.array([0.0, 0.6, 0.0]))
    right = gaze.neck_deg(np.array([0.3, 0.6, 0.0]))
    below = gaze.neck_deg(
        np.array(object_pose({"object_y_m": 0.3, "object_yaw_deg": 0}).position_m)
    )
    assert right[1] < straight[1] - 10.0
    assert below[0] < straight[0] - 5.0


@pytest.mark.slow
def test_fitting_gives_the_postures_in_the_repository():
    fitted, stored = PostureFitter().fit(), load_key_postures()
    for postures in ("object", "obstacle"):
        for name, rows in getattr(stored, postures).items():
            np.testing.assert_allclose(getattr(fitted, postures)[name], rows, atol=0.05)
