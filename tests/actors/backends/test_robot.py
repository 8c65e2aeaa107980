"""The robot as every backend builds and drives it."""

from __future__ import annotations

import numpy as np
import pytest

from actors.backends.robot import (
    MOTOR_COUNT,
    build_robot,
    drive_of,
    joints_from_motors_rad,
    motor_ramp_deg,
    motors_from_joints_deg,
    motors_of,
)
from actors.simulator import JointTargets
from proto.body import JOINT_NAMES
from proto.errors import UserError


def test_a_cache_that_cannot_be_written_is_explained(monkeypatch):
    monkeypatch.setenv("VMDNN_CACHE", "/proc/nowhere")
    with pytest.raises(UserError, match="VMDNN_CACHE"):
        build_robot()


def test_every_joint_has_a_drive():
    joints = build_robot().joints
    assert len(joints) == 28
    limits = [drive_of(joint).torque_limit for joint in joints]
    assert limits == [20.0] * 2 + [60.0] * 7 + [0.6] * 19


def test_motors_are_in_the_order_of_the_observed_joints():
    targets = JointTargets(np.arange(2.0), np.arange(2.0, 9.0), np.arange(9.0, 18.0))
    assert motors_of(targets).tolist() == list(range(MOTOR_COUNT))
    assert len(JOINT_NAMES) == MOTOR_COUNT


def test_motor_angles_are_recovered_from_the_joints_that_they_move():
    motors_deg = np.random.default_rng(0).uniform(0.0, 60.0, MOTOR_COUNT)
    joints_rad = joints_from_motors_rad(motors_deg)
    assert joints_rad.shape == (28,)
    assert motors_from_joints_deg(joints_rad) == pytest.approx(motors_deg)


def test_a_ramp_ends_at_its_target_and_does_not_include_its_start():
    before, after = np.zeros(MOTOR_COUNT), np.full(MOTOR_COUNT, 4.0)
    assert motor_ramp_deg(before, after, 4)[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]
