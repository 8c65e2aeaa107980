"""The built robot: the official kinematics with our limits, eye, hand and colliders."""

import multiprocessing
from collections.abc import Callable
from multiprocessing.pool import Pool, ThreadPool
from pathlib import Path

import icub_models
import numpy as np
import pinocchio as pin
import pytest
import trimesh

from proto.body import ACTION_VALUES, ARM, NECK
from sim_assets.hand import PHALANGES
from sim_assets.icub import (
    ARM_JOINTS,
    COLLIDERS,
    EYE,
    HAND,
    JOINT_LIMITS_DEG,
    NECK_JOINTS,
    SOURCE_MODEL,
    build_icub,
)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return build_icub(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def robot(built):
    return pin.buildModelFromUrdf(str(built.urdf))


def frame_pose(model, frame, angles):
    """Pose (4, 4) of a frame at named joint angles (radians), other joints at zero."""
    configuration = pin.neutral(model)
    for name, angle in angles.items():
        configuration[model.joints[model.getJointId(name)].idx_q] = angle
    data = model.createData()
    pin.framesForwardKinematics(model, data, configuration)
    return data.oMf[model.getFrameId(frame)].homogeneous


def test_limits_agree_with_the_action():
    assert tuple(value.name for value in ACTION_VALUES[NECK]) == NECK_JOINTS
    assert tuple(value.name for value in ACTION_VALUES[ARM]) == ARM_JOINTS
    for value in ACTION_VALUES[: ARM.stop]:
        assert JOINT_LIMITS_DEG[value.name] == (value.minimum, value.maximum)


def test_only_neck_arm_and_fingers_move(built, robot):
    assert set(robot.names[1:]) == set(built.joints)
    assert len(built.joints) == 9 + len(PHALANGES)


def test_limits_are_in_the_urdf(robot):
    for name, limits in JOINT_LIMITS_DEG.items():
        index = robot.joints[robot.getJointId(name)].idx_q
        lower, upper = robot.lowerPositionLimit[index], robot.upperPositionLimit[index]
        assert np.rad2deg([lower, upper]) == pytest.approx(limits)


@pytest.mark.parametrize("frame", ["head", "r_forearm", HAND])
def test_kinematics_are_the_official_ones(robot, frame):
    official = pin.buildModelFromUrdf(str(icub_models.get_model_file(SOURCE_MODEL)))
    rng = np.random.default_rng(1)
    for _ in range(5):
        angles = {
            name: np.deg2rad(rng.uniform(*limits)) for name, limits in JOINT_LIMITS_DEG.items()
        }
        expected = frame_pose(official, frame, angles)
        assert frame_pose(robot, frame, angles) == pytest.approx(expected, abs=1e-9)


def test_the_eye_looks_ahead_and_thirty_degrees_down(robot):
    eye = frame_pose(robot, EYE, {})
    assert eye[:3, 3] == pytest.approx([-0.0628, -0.034, 0.3408], abs=1e-9)
    forward, left, up = eye[:3, :3].T
    assert forward == pytest.approx([-np.sqrt(0.75), 0, -0.5])  # root: x back, y right, z up
    assert left == pytest.approx([0, -1, 0])
    assert up == pytest.approx([-0.5, 0, np.sqrt(0.75)])


def test_a_negative_neck_pitch_looks_down(robot):
    eye = frame_pose(robot, EYE, {"neck_pitch": np.deg2rad(-40)})
    assert np.rad2deg(np.arcsin(eye[2, 0])) == pytest.approx(-70, abs=1e-6)


def test_fingers_flex_towards_the_palm_side(robot):
    straight = frame_pose(robot, "r_middle_3", {})
    flexed = frame_pose(robot, "r_middle_3", {"r_middle_1_joint": 0.5})
    out_of_palm = frame_pose(robot, HAND, {})[:3, 2]
    assert (flexed - straight)[:3, 3] @ out_of_palm > 0.01


def test_every_collider_sits_on_a_link(robot):
    assert all(robot.existFrame(collider.link) for collider in COLLIDERS)
    assert sum(collider.link.split("_")[-1] in "123" for collider in COLLIDERS) >= 15


def test_colliders_span_the_arm_from_joint_to_joint(robot):
    """The forearm's capsule reaches from the elbow's to the wrist's axis."""
    forearm = next(collider for collider in COLLIDERS if collider.link == "r_forearm")
    pose = frame_pose(robot, "r_forearm", {})
    end = pose[:3, :3] @ forearm.end_m + pose[:3, 3]
    wrist = frame_pose(robot, "r_wrist_1", {})[:3, 3]
    assert np.linalg.norm(end - wrist) < forearm.radius_m


def test_the_visuals_cover_the_links_that_each_view_needs(built):
    eye = {visual.link for visual in built.seen_by_eye}
    outside = {visual.link for visual in built.seen_from_outside}
    hand = {phalanx.link for phalanx in PHALANGES}
    assert hand | {"r_forearm", HAND} <= eye < outside
    assert {"head", "chest", "root_link"} <= outside
    assert not {"head", "root_link"} & eye  # the eye looks out of the head


def faces(visuals, link):
    return sum(len(trimesh.load(v.mesh).faces) for v in visuals if v.link == link)


def test_the_eye_renders_simplified_meshes(built):
    assert faces(built.seen_from_outside, "r_upper_arm") > 15000
    assert 100 < faces(built.seen_by_eye, "r_upper_arm") <= 1000


def test_meshes_have_the_official_positions(built):
    """The forearm's mesh spans its collider, in metres and in the link's frame."""
    forearm = next(visual for visual in built.seen_by_eye if visual.link == "r_forearm")
    low, high = trimesh.load(forearm.mesh).bounds
    collider = next(c for c in COLLIDERS if c.link == "r_forearm")
    for end in (collider.start_m, collider.end_m):
        assert (low < end).all()
        assert (end < high).all()
    assert (high - low).max() < 0.2


def test_the_build_is_cached(built):
    folder = built.urdf.parent
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert build_icub(folder.parent) == built
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.parametrize(
    "pool", [multiprocessing.get_context("spawn").Pool, ThreadPool], ids=["processes", "threads"]
)
def test_several_can_build_at_once(tmp_path: Path, pool: Callable[[int], Pool]):
    with pool(2) as builders:
        models = builders.map(build_icub, [tmp_path] * 2)
    assert len(set(models)) == 1
    assert models[0].urdf.is_file()
    assert list(tmp_path.iterdir()) == [models[0].urdf.parent]
