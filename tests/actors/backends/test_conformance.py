"""Requirements for every backend: frames, control, contact, repeatability and pictures.

The suite runs on all installed built-in backends, or on one of your own; see
docs/your-own-simulator.md.
"""

from __future__ import annotations

import gc
import math
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace

import cv2
import numpy as np
import pytest

from actors.attention import crop_of_focus
from actors.backends import light
from actors.backends.eye import SKY
from actors.simulator import (
    DARK_SCREEN,
    ROBOT,
    Box,
    Crop,
    JointTargets,
    Knock,
    Pose,
    Scene,
    Screen,
    Shove,
    Simulator,
    abilities_of,
    load_backend,
    make_simulator,
)
from proto.config import SimulatorConfig
from proto.disturbances import Ability
from sim_assets.hand import motors_from_grasp

ARM = (-30.0, 30.0, 30.0, 60.0, -30.0, -30.0, 10.0)
TABLE = Box("table", (0.9, 0.44, 0.04), Pose((0.05, 0.31, -0.02)), (0.85, 0.83, 0.78))
OBSTACLE = Box("obstacle", (0.01, 0.26, 0.2), Pose((0.27, 0.3, 0.1)), (0.9, 0.8, 0.1), watched=True)
OBJECT = Box("object", (0.028, 0.10, 0.07), Pose((0.06, 0.25, 0.035)), (0.8, 0.1, 0.1), mass_kg=0.1)


def targets(arm=ARM, neck=(-38.0, -10.0), level=1.0) -> JointTargets:
    return JointTargets(np.array(neck), np.array(arm), motors_from_grasp(level))


def moved_roll(by_deg: float) -> tuple[float, ...]:
    return (ARM[0], ARM[1] + by_deg, *ARM[2:])


def scene(*boxes: Box, start: JointTargets | None = None) -> Scene:
    return Scene(boxes or (TABLE, OBSTACLE, OBJECT), start or targets(), table_drop_m=0.15)


@pytest.fixture(scope="module")
def blind(backend: str) -> Iterator[Simulator]:
    """Renders nothing."""
    config = SimulatorConfig(backend=backend, render=False)
    with closing(make_simulator(config)) as simulator:
        yield simulator


@pytest.fixture(scope="module")
def seeing(backend: str) -> Iterator[Simulator]:
    """Renders."""
    with closing(make_simulator(SimulatorConfig(backend=backend))) as simulator:
        yield simulator


@pytest.fixture
def another(backend: str) -> Iterator[Callable[..., Simulator]]:
    """Makes more simulators, with other settings."""
    with ExitStack() as stack:
        yield lambda **settings: stack.enter_context(
            closing(make_simulator(SimulatorConfig(backend=backend, **settings)))
        )


def run(simulator, steps, goal):
    """Touches, one set for each step, while the arm moves to the goal in a straight line."""
    start = simulator.joints_deg()
    reports = []
    for step in range(1, steps + 1):
        done = step / steps
        arm = start[2:9] + (np.array(goal.arm_deg) - start[2:9]) * done
        reports.append(simulator.step(JointTargets(goal.neck_deg, arm, goal.hand_deg)).touches)
    return reports


def values(joints: JointTargets):
    return np.concatenate([joints.neck_deg, joints.arm_deg, joints.hand_deg])


# --- the class --------------------------------------------------------------------------------


def test_it_reports_that_it_can_render_here(backend):
    diagnosis = load_backend(backend).diagnose()
    assert diagnosis.works, diagnosis.text()
    assert diagnosis.found


def test_it_has_its_name_and_the_control_period(backend, blind, another):
    assert blind.name == backend
    assert blind.control_period_s == 0.1
    assert another(render=False, control_period_s=0.02).control_period_s == 0.02


# --- frames and control -----------------------------------------------------------------------


def test_starts_at_rest_in_the_start_posture_and_stays(blind):
    blind.reset(scene())
    assert blind.joints_deg() == pytest.approx(values(targets()), abs=1e-3)
    for _ in range(10):
        blind.step(targets())
    assert blind.joints_deg() == pytest.approx(values(targets()), abs=0.05)
    pose = blind.bodies()["object"]
    assert pose.position_m == pytest.approx(OBJECT.pose.position_m, abs=1e-3)


def test_world_frame_lies_on_the_table_under_the_root(blind):
    blind.reset(scene(start=targets(neck=(0.0, 0.0))))
    eye = blind.bodies()["l_eye"]
    # in the root frame (x back, y right): -0.0628, -0.034, 0.3408
    assert eye.position_m == pytest.approx((-0.034, 0.0628, 0.3408 + 0.15), abs=1e-4)


def test_bodies_are_the_boxes_and_the_moving_links(blind):
    blind.reset(scene())
    names = set(blind.bodies())
    assert {"table", "obstacle", "object", "head", "r_hand_dh_frame", "r_little_3"} <= names
    assert not {"root_link", "torso_1", "chest"} & names


def test_every_motor_reaches_its_target(blind):
    blind.reset(scene(TABLE))
    goal = targets(arm=(-50.0, 50.0, 10.0, 80.0, 20.0, -10.0, -5.0), neck=(-20.0, 15.0), level=6.0)
    run(blind, 15, goal)
    for _ in range(10):
        blind.step(goal)
    assert blind.joints_deg() == pytest.approx(values(goal), abs=0.5)


def test_targets_move_linearly_within_the_period(blind, another):
    """One long step is the same as ten short ones along the straight line to its target."""
    blind.reset(scene(TABLE))
    blind.step(targets(arm=moved_roll(8.0)))
    quick = another(render=False, control_period_s=0.01)
    quick.reset(scene(TABLE))
    for tenth in range(1, 11):
        quick.step(targets(arm=moved_roll(0.8 * tenth)))
    assert blind.joints_deg() == pytest.approx(quick.joints_deg(), abs=1e-3)
    assert blind.joints_deg()[3] > ARM[1] + 1.0


def test_a_target_that_is_not_a_number_is_refused(blind):
    blind.reset(scene())
    with pytest.raises(ValueError, match="finite"):
        blind.step(targets(arm=(math.nan, *ARM[1:])))


# --- contact ----------------------------------------------------------------------------------


def test_pushing_the_obstacle_is_reported_from_the_touch_on(blind):
    goal = targets(arm=moved_roll(30.0))
    blind.reset(scene(TABLE, start=goal))
    palm = blind.bodies()["r_hand_dh_frame"].position_m
    blind.reset(scene(TABLE, replace(OBSTACLE, pose=Pose(palm))))
    touched = [("obstacle", ROBOT) in report for report in run(blind, 25, goal)]
    assert not touched[0]
    assert touched[-1]
    assert touched == sorted(touched)


def test_a_touch_between_two_control_steps_is_not_missed(blind):
    """A box that falls past the edge of a watched one touches it for a few physics steps only."""
    ledge = Box("ledge", (0.1, 0.1, 0.02), Pose((0.3, 0.3, 0.5)), (1, 1, 1), watched=True)
    falling = Box(
        "falling",
        (0.04, 0.04, 0.04),
        Pose((0.369, 0.3, 0.56)),
        (1, 1, 1),
        mass_kg=0.1,
        friction=0.0,
    )
    blind.reset(scene(ledge, falling))
    reports = [blind.step(targets()).touches for _ in range(8)]
    assert ("ledge", "falling") in set().union(*reports)
    assert not reports[-1]
    assert blind.bodies()["falling"].position_m[2] < 0.2


def test_a_near_body_is_not_reported_as_touching(blind):
    beside = Box("beside", (0.05, 0.05, 0.05), Pose((0.0, 0.3, 0.025)), (1, 1, 1), watched=True)
    near = Box("near", (0.05, 0.05, 0.05), Pose((0.051, 0.3, 0.025)), (1, 1, 1), mass_kg=0.1)
    blind.reset(scene(TABLE, beside, near))
    assert not any(blind.step(targets()).touches for _ in range(5))


def test_touches_of_unwatched_bodies_are_not_reported(blind):
    blind.reset(scene())
    assert blind.step(targets()).touches == frozenset()  # though the object stands on the table


@pytest.mark.parametrize("height_m", [0.0, 0.06])
def test_a_touch_lasts_from_the_first_overlap_on(blind, height_m):
    """A box that stands on a watched one touches it in each step; one that falls, when it lands."""
    plate = Box("plate", (0.1, 0.1, 0.02), Pose((0.0, 0.3, 0.5)), (1, 1, 1), watched=True)
    centre = Pose((0.0, 0.3, 0.53 + height_m))
    box = Box("box", (0.04, 0.04, 0.04), centre, (1, 1, 1), mass_kg=0.1)
    blind.reset(scene(plate, box))
    touched = [("plate", "box") in blind.step(targets()).touches for _ in range(6)]
    assert touched[0] == (height_m == 0.0)  # it needs 0.11 s to fall so far
    assert all(touched[2:])


@pytest.mark.parametrize(
    ("slope_deg", "frictions", "slides"),
    [
        (20, (1.0, 0.0), False),  # tan 0.36: the mean holds the box, the smaller would not
        (20, (0.2, 0.2), True),
        (35, (1.0, 0.2), True),  # tan 0.70: the mean does not hold it, the greater would
        (35, (1.0, 0.6), False),
    ],
)
def test_friction_between_two_bodies_is_the_mean_of_both(blind, slope_deg, frictions, slides):
    tilt = math.radians(slope_deg)
    turn = (math.cos(tilt / 2), math.sin(tilt / 2), 0.0, 0.0)
    up = 0.03 * np.array((0.0, -math.sin(tilt), math.cos(tilt)))
    plate, box = (
        Box(name, size, Pose(tuple(np.array((0.0, 0.3, 0.5)) + shift), turn), (1, 1, 1),
            mass_kg=mass, friction=friction)
        for name, size, shift, mass, friction in zip(
            ("plate", "box"), ((0.4, 0.4, 0.02), (0.08, 0.08, 0.04)), (0.0 * up, up), (None, 0.1),
            frictions, strict=True,
        )
    )  # fmt: skip
    blind.reset(scene(plate, box))
    for _ in range(5):
        blind.step(targets())
    way_m = np.linalg.norm(np.subtract(blind.bodies()["box"].position_m, box.pose.position_m))
    assert (way_m > 0.02) == slides
    assert slides or way_m < 0.003


def rotation(quaternion):
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


# --- disturbances -----------------------------------------------------------------------------


def needs(simulator, ability):
    if ability not in abilities_of(simulator):
        pytest.skip(f"{simulator.name} does not say that it can play {ability}")


def played(simulator, disturbed, steps=16):
    """Measured joints after each step of an episode in which nothing is to move."""
    simulator.reset(disturbed)
    rows = []
    for _ in range(steps):
        simulator.step(disturbed.start)
        rows.append(simulator.joints_deg())
    return np.array(rows)


def test_abilities_are_known(blind):
    assert abilities_of(blind) <= set(Ability)


def test_a_shove_moves_and_turns_a_box_within_its_step_and_leaves_it_at_rest(blind):
    needs(blind, Ability.SHOVES)
    shove = Shove("object", 4, (-0.01, 0.03), 20.0)
    blind.reset(replace(scene(), shoves=(shove,)))
    poses = []
    for _ in range(9):
        blind.step(targets())
        poses.append(blind.bodies()["object"])
    x, y, z = OBJECT.pose.position_m
    for before in poses[:4]:
        assert before.position_m == pytest.approx((x, y, z), abs=1e-3)
    half = np.deg2rad(20.0) / 2
    for after in poses[4:]:
        assert after.position_m == pytest.approx((x - 0.01, y + 0.03, z), abs=1.5e-3)
        assert after.quaternion == pytest.approx((np.cos(half), 0, 0, np.sin(half)), abs=5e-3)


def test_a_knock_turns_its_joint_while_it_lasts(blind):
    """The drive holds against the torque: 400 Nm/rad at the arm's joints."""
    needs(blind, Ability.KNOCKS)
    plain = played(blind, scene(TABLE))
    for sign in (1.0, -1.0):
        knock = Knock("r_elbow", sign * 20.0, 3, 3)
        turned = played(blind, replace(scene(TABLE), knocks=(knock,))) - plain
        elbow = 2 + 3
        assert turned[:3] == pytest.approx(0.0, abs=0.02)
        expected = sign * np.rad2deg(20.0 / 400.0) * (1 - math.exp(-3))
        assert turned[5, elbow] == pytest.approx(expected, rel=0.1)
        assert turned[14, elbow] == pytest.approx(0.0, abs=0.05)
        rest_of_the_arm = np.delete(turned, elbow, axis=1)[:, 2:8]
        assert np.abs(rest_of_the_arm).max() < 0.2 * abs(expected)


def test_more_damping_lets_a_joint_lag(blind):
    needs(blind, Ability.DAMPING)
    goal, roll = targets(arm=moved_roll(20.0)), 3
    lags = []
    for damping in ({}, {"r_shoulder_roll": 2.0}, {"r_elbow": 2.0}):
        blind.reset(replace(scene(TABLE), damping=damping))
        run(blind, 5, goal)
        lags.append(ARM[1] + 20.0 - blind.joints_deg()[roll])
    plain, damped, other = lags
    assert damped == pytest.approx(2 * plain, rel=0.2)
    assert other == pytest.approx(plain, rel=0.05)


def test_a_turned_eye_sees_what_lies_in_that_direction(seeing):
    """Turned to the left, it sees the same as an eye that the neck has turned to the left."""
    needs(seeing, Ability.EYE_TURN)
    start = targets(neck=(-38.0, -10.0))
    seeing.reset(scene(start=start))
    straight = seeing.observe(Crop()).image.astype(float)
    half = np.deg2rad(3.0) / 2
    moved = {}
    for name, axis in (("left", (0.0, 0.0, 1.0)), ("up", (0.0, -1.0, 0.0)), ("roll", (1.0, 0, 0))):
        turn = (math.cos(half), *(math.sin(half) * value for value in axis))
        seeing.reset(replace(scene(start=start), eye_turn=turn))
        moved[name] = seeing.observe(Crop()).image.astype(float)
        assert np.abs(moved[name] - straight).mean() > 0.5
    pixels = round(3.0 / 50.0 * 48)
    shifted = np.abs(moved["left"][:, pixels:] - straight[:, :-pixels]).mean()
    assert shifted < 0.6 * np.abs(moved["left"][:, pixels:] - straight[:, pixels:]).mean()
    shifted = np.abs(moved["up"][pixels:] - straight[:-pixels]).mean()
    assert shifted < 0.6 * np.abs(moved["up"][pixels:] - straight[pixels:]).mean()
    seeing.reset(scene(start=start))
    assert np.array_equal(seeing.observe(Crop()).image, straight)


def test_after_a_disturbed_episode_a_plain_one_is_as_before(blind):
    plain = played(blind, scene())
    able = abilities_of(blind)
    disturbances = {
        Ability.SHOVES: {"shoves": (Shove("object", 2, (0.0, 0.02), 10.0),)},
        Ability.KNOCKS: {"knocks": (Knock("r_elbow", 30.0, 13, 3),)},
        Ability.DAMPING: {"damping": {"r_elbow": 3.0}},
        Ability.EYE_TURN: {"eye_turn": (math.cos(0.01), math.sin(0.01), 0.0, 0.0)},
    }
    given = {key: value for each in able for key, value in disturbances[each].items()}
    played(blind, replace(scene(), **given))
    assert np.array_equal(played(blind, scene()), plain)


# --- repeatability ----------------------------------------------------------------------------


def trace(simulator):
    """Everything observed in an episode with contact, bit by bit."""
    simulator.reset(scene())
    rows = []
    for step in range(12):
        report = simulator.step(targets(arm=moved_roll(3.0 * step), level=1 + step / 2))
        seen = simulator.observe(Crop(240, 180))
        rows.append(
            (
                sorted(report.touches),
                seen.image.tobytes(),
                seen.joints_deg.tobytes(),
                simulator.bodies().rows.tobytes(),
            )
        )
    return rows


def test_the_same_scene_gives_the_same_episode_after_any_other(seeing):
    first = trace(seeing)
    other = Box("other", (0.05, 0.2, 0.05), Pose((0.1, 0.3, 0.025)), (0, 0, 1), mass_kg=0.3)
    seeing.reset(scene(TABLE, other, start=targets(level=8.0)))
    run(seeing, 10, targets(arm=(-60.0, 60.0, 0.0, 30.0, 0.0, 0.0, 0.0)))
    seeing.outside_picture(64, 48)
    assert trace(seeing) == first


def test_another_simulator_gives_the_same_episode(seeing, another):
    assert trace(another()) == trace(seeing)


def test_a_simulator_that_is_collected_harms_no_other(seeing, another, backend):
    seeing.reset(scene())
    before = seeing.observe(Crop()).image
    forgotten = make_simulator(SimulatorConfig(backend=backend))
    forgotten.reset(scene())
    forgotten.observe(Crop())
    forgotten.outside_picture(64, 48)
    del forgotten
    gc.collect()
    assert np.array_equal(seeing.observe(Crop()).image, before)
    late = another()
    late.reset(scene())
    assert np.array_equal(late.observe(Crop()).image, before)


GROWTH_PROGRAM = """
import sys
from pathlib import Path
from actors.simulator import Crop, make_simulator
from actors.tasks.experiment2.task import Experiment2
from proto.config import SimulatorConfig, TaskConfig

backend, makings, resets = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
task = Experiment2(TaskConfig(name="experiment2"))
scenes = [task.scene(situation) for situation in task.tutored()[:4]]

def memory_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

def play(simulator, resets):
    for number in range(resets):
        scene = scenes[number % len(scenes)]
        simulator.reset(scene)
        simulator.step(scene.start)
        simulator.observe(Crop())

for making in range(makings):
    simulator = make_simulator(SimulatorConfig(backend=backend))
    play(simulator, 20)
    if making == makings // 6:
        before = memory_mb()
    if making < makings - 1:
        simulator.close()
play(simulator, 30)
before = before if makings > 1 else memory_mb()
play(simulator, resets)
print(memory_mb() - before)
"""


def growth_mb(backend: str, makings: int, resets: int) -> float:
    """Growth of a process that makes and closes simulators, and resets the last one."""
    arguments = [backend, str(makings), str(resets)]
    result = subprocess.run(
        [sys.executable, "-c", GROWTH_PROGRAM, *arguments],
        capture_output=True,
        text=True,
        check=True,
    )
    return float(result.stdout)


def test_memory_stays_the_same_over_many_episodes(backend):
    assert growth_mb(backend, makings=1, resets=100) < 1.5


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_memory_stays_the_same_over_thousands_of_episodes(backend):
    assert growth_mb(backend, makings=1, resets=3000) < 5.0


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_what_is_closed_is_freed(backend):
    """Of what the driver allocates for a simulator, it may keep some for the next."""
    assert growth_mb(backend, makings=60, resets=0) < 20.0


# --- pictures ---------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [1, 8, 20])
def test_a_crop_is_the_crop_of_the_whole_eye_image(seeing, level):
    crop = Crop(320 - 8 * (level - 1), 240 - 6 * (level - 1))
    seeing.reset(scene())
    whole = cv2.cvtColor(seeing.eye_picture(Crop(), 1280, 960), cv2.COLOR_RGB2GRAY)
    left, top = 4 * (320 - crop.width) // 2, 4 * (240 - crop.height) // 2
    cut = whole[top : top + 4 * crop.height, left : left + 4 * crop.width]
    expected = cv2.resize(cut, (64, 48), interpolation=cv2.INTER_AREA).astype(float)
    image = seeing.observe(crop).image.astype(float)
    assert image.shape == (48, 64)
    assert np.abs(image - expected).mean() < 1.0
    assert np.percentile(np.abs(image - expected), 99) < 20.0
    assert image.std() > 10.0


def seen_at(simulator, point_m, width, height):
    """Row and column where a point of the world lies in a picture of the whole eye image."""
    eye = simulator.bodies()["l_eye"]
    depth, left, up = rotation(eye.quaternion).T @ (np.array(point_m) - eye.position_m)
    focal = height / 2 / math.tan(math.radians(25))
    column, row = width / 2 - focal * left / depth, height / 2 - focal * up / depth
    return round(row - 0.5), round(column - 0.5)


def grey_at(simulator, point_m):
    """Grey value of the whole eye image where a point of the world is seen."""
    return float(simulator.observe(Crop()).image[seen_at(simulator, point_m, 64, 48)])


@pytest.mark.parametrize("level", [1.0, 6.6, 13.2, 20.0])
def test_a_crop_keeps_its_shape(seeing, level):
    """A small box off the middle is seen where a camera with square pixels sees it."""
    x, y, z = SCREEN_CENTRE
    centre = (x + 0.05, y, z + 0.04)
    mark = Box("mark", (0.01, 0.01, 0.01), Pose(centre), (0.0, 0.9, 0.0))
    seeing.reset(scene(mark, start=targets(neck=(0.0, 0.0))))
    crop = crop_of_focus(level)
    picture = seeing.eye_picture(crop, 640, 480).astype(int)
    rows, columns = np.nonzero(picture[..., 1] - picture[..., 0] > 60)
    row, column = seen_at(seeing, centre, 640, 480)
    magnified = 240 / (240 - 6 * (level - 1))
    expected = (240 + magnified * (row + 0.5 - 240), 320 + magnified * (column + 0.5 - 320))
    assert (rows.mean() + 0.5, columns.mean() + 0.5) == pytest.approx(expected, abs=2.5)


def test_hand_object_obstacle_and_table_have_different_brightness(seeing):
    seeing.reset(scene())
    hand = grey_at(seeing, seeing.bodies()["r_middle_1"].position_m)
    thing = grey_at(seeing, (0.06, 0.25, 0.07))
    table = grey_at(seeing, (-0.05, 0.25, 0.0))
    near_wall = replace(OBSTACLE, pose=Pose((0.12, 0.3, 0.1)))
    seeing.reset(scene(TABLE, near_wall))
    wall = grey_at(seeing, (0.115, 0.3, 0.12))
    greys = sorted([hand, thing, wall, table])
    assert greys == [hand, thing, wall, table]
    assert min(np.diff(greys)) > 20.0


def test_a_recorded_state_can_be_shown_again(seeing):
    seeing.reset(scene())
    run(seeing, 8, targets(arm=(-30.0, 45.0, 20.0, 70.0, 0.0, -20.0, 0.0), neck=(-30.0, 5.0)))
    joints, bodies = seeing.joints_deg(), dict(seeing.bodies())
    picture = seeing.eye_picture(Crop(), 160, 120)
    seeing.reset(scene())
    assert np.abs(seeing.eye_picture(Crop(), 160, 120).astype(int) - picture).mean() > 2.0
    seeing.show(joints, {name: bodies[name] for name in ("table", "obstacle", "object")}, 8)
    assert np.abs(seeing.eye_picture(Crop(), 160, 120).astype(int) - picture).mean() < 0.5
    for name in ("r_hand_dh_frame", "object", "head"):
        assert seeing.bodies()[name].position_m == pytest.approx(bodies[name].position_m, abs=1e-3)


def test_fingers_that_hold_something_are_shown_as_they_were(seeing):
    """A box stops the fingers, so that their joints differ from what their motors' angles say."""
    seeing.reset(scene(TABLE, start=targets(level=1.0)))
    palm = seeing.bodies()["r_hand_dh_frame"]
    place = np.array(palm.position_m) + rotation(palm.quaternion) @ np.array((0.05, 0.0, 0.03))
    held = Box("held", (0.04, 0.04, 0.04), Pose(tuple(place), palm.quaternion), (0, 0, 1))
    start = scene(TABLE, held, start=targets(level=1.0))
    seeing.reset(start)
    for level in np.linspace(1.0, 20.0, 10):
        seeing.step(targets(level=level))
    joints, bodies = seeing.joints_deg(), dict(seeing.bodies())
    picture = seeing.eye_picture(Crop(), 320, 240)
    fingers = [name for name in bodies if name.startswith("r_") and name[-1].isdigit()]

    def errors_m():
        shown = seeing.bodies()
        return [math.dist(shown[name].position_m, bodies[name].position_m) for name in fingers]

    seeing.reset(start)
    seeing.show(joints, {}, 10)
    assert max(errors_m()) > 5e-3, "the motors' angles do not tell all"
    seeing.show(joints, bodies, 10)
    assert max(errors_m()) < 2e-4
    assert np.abs(seeing.eye_picture(Crop(), 320, 240).astype(int) - picture).mean() < 0.1


@pytest.mark.parametrize(
    ("normal", "quaternion"),
    [
        ((0, 0, 1), (1, 0, 0, 0)),
        ((0, -1, 0), (np.cos(np.pi / 4), np.sin(np.pi / 4), 0, 0)),
        ((0, -np.sqrt(0.5), np.sqrt(0.5)), (np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0)),
        ((1, 0, 0), (np.cos(np.pi / 4), 0, np.sin(np.pi / 4), 0)),
    ],
    ids=["up", "to the robot", "tilted", "to the right"],
)
def test_the_brightness_of_a_surface_follows_the_shared_light(seeing, normal, quaternion):
    """A plate whose upper side is turned to `normal`, at the left before the robot."""
    centre, colour = np.array((-0.15, 0.35, 0.25)), (0.5, 0.3, 0.8)
    plate = Box("plate", (0.1, 0.1, 0.01), Pose(tuple(centre), quaternion), colour)
    seeing.reset(scene(plate, start=targets(neck=(0.0, 0.0))))
    picture = seeing.eye_picture(Crop(), 640, 480)
    row, column = seen_at(seeing, centre + 0.005 * np.array(normal), 640, 480)
    expected = light.brightness(np.array(normal, dtype=float)) * np.array(colour)
    assert picture[row, column] == pytest.approx(255 * expected ** (1 / light.GAMMA), abs=1.5)


SCREEN_CENTRE = (-0.034, 0.5, 0.24)
"""In the middle of the eye image when the neck is at zero."""


def screen_scene(*frames, boxes=(TABLE,)) -> Scene:
    """A scene with a screen that the eye looks at."""
    screen = Screen((0.16, 0.12), Pose(SCREEN_CENTRE), np.array(frames, dtype=np.uint8))
    return replace(scene(*boxes, start=targets(neck=(0.0, 0.0))), screen=screen)


def plain(grey) -> np.ndarray:
    return np.full((12, 16), grey)


def test_a_screen_shows_one_frame_in_each_control_step_and_then_is_dark(seeing):
    seeing.reset(screen_scene(plain(40), plain(120), plain(200)))
    shown = []
    for _ in range(5):
        shown.append(grey_at(seeing, SCREEN_CENTRE))
        seeing.step(targets(neck=(0.0, 0.0)))
    assert shown == pytest.approx([40, 120, 200, DARK_SCREEN, DARK_SCREEN], abs=1)
    seeing.reset(screen_scene(plain(90)))
    assert grey_at(seeing, SCREEN_CENTRE) == pytest.approx(90, abs=1)
    seeing.reset(scene(TABLE, start=targets(neck=(0.0, 0.0))))
    assert grey_at(seeing, SCREEN_CENTRE) == pytest.approx(SKY, abs=1), "the screen is gone"


def test_a_screen_stands_upright_with_its_left_edge_at_minus_x(seeing):
    frame = np.block([[plain(50), plain(100)], [plain(150), plain(200)]])
    seeing.reset(screen_scene(frame))
    x, y, z = SCREEN_CENTRE
    corners = [(x + dx, y, z + dz) for dz in (0.03, -0.03) for dx in (-0.04, 0.04)]
    seen = [grey_at(seeing, corner) for corner in corners]
    assert seen == pytest.approx([50, 100, 150, 200], abs=1)


def test_a_recorded_step_of_a_screen_can_be_shown_again(seeing):
    seeing.reset(screen_scene(plain(40), plain(120), plain(200)))
    seeing.show(seeing.joints_deg(), {}, 2)
    assert grey_at(seeing, SCREEN_CENTRE) == pytest.approx(200, abs=1)


def test_nothing_touches_a_screen(blind):
    x, y, z = SCREEN_CENTRE
    above = Pose((x, y, z + 0.15))
    falling = Box("falling", (0.04, 0.04, 0.04), above, (1, 1, 1), mass_kg=0.1)
    heights_m = []
    for start in (screen_scene(plain(40), boxes=(falling,)), scene(falling)):
        blind.reset(start)
        for _ in range(4):
            blind.step(start.start)
        heights_m.append(blind.bodies()["falling"].position_m[2])
    assert heights_m[0] == heights_m[1] < z - 0.1


def share_of(picture, red, green, blue):
    """Share of pixels within 40 of a colour."""
    return (np.abs(picture.astype(int) - [red, green, blue]).max(axis=2) < 40).mean()


def test_the_outside_picture_shows_robot_table_obstacle_and_object(seeing):
    seeing.reset(scene())
    picture = seeing.outside_picture(320, 240)
    assert picture.shape == (240, 320, 3)
    assert picture.dtype == np.uint8
    assert share_of(picture, 224, 222, 217) > 0.1  # table
    assert share_of(picture, 190, 180, 70) > 0.01  # obstacle
    assert share_of(picture, 200, 75, 75) > 0.002  # object, of which a part lies in shadow
    assert share_of(picture, 100, 40, 40) > 0.02  # the robot's covers
    assert share_of(picture, 40, 40, 45) > 0.003  # its hand


def test_without_rendering_the_eye_sees_black(blind):
    blind.reset(scene())
    seen = blind.observe(Crop())
    assert seen.image.shape == (48, 64)
    assert not seen.image.any()
    assert seen.joints_deg == pytest.approx(blind.joints_deg())
