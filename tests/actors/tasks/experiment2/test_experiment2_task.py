"""Experiment II: its situations, clips, scene, baselines and options."""

from __future__ import annotations

import itertools
from collections import Counter

import cv2
import numpy as np
import pytest

from actors.player import play
from actors.policies.by_name import make_policy
from actors.simulator import DARK_SCREEN, make_simulator
from actors.tasks.registry import make_task
from proto.config import SimulatorConfig, TaskConfig
from proto.episode import Kind
from proto.errors import UserError
from proto.seeds import CORRECTIONS, PRACTICE, TRIALS_BELOW
from sim_assets.gestures.drawing import draw_clip
from sim_assets.gestures.subject import Subject

DARK = np.zeros((48, 64), dtype=np.uint8)
FIXED = {"indicated_y_m": 0.255, "other_y_m": 0.255, "indicated_yaw_deg": 0.0, "other_yaw_deg": 0.0}


def experiment2(**options):
    return make_task(TaskConfig.model_validate({"name": "experiment2", **options}))


TASK = experiment2()


def case_of(situation):
    """Which of the paper's eight cases a situation is of."""
    names = ("indicated_x_m", "indicated_kind", "other_kind")
    return tuple(situation[name] for name in names)


def clips_of(situations):
    return {(s["indicated_x_m"], s["subject"], s["take"]) for s in situations}


def test_an_episode_has_eight_subtasks_and_begins_with_the_gesture():
    assert len(TASK.phases) == 148
    assert len(TASK.phase_names) == 8
    assert (TASK.phases[:40] == 0).all()


def test_a_delay_is_a_subtask_after_the_gesture():
    task = experiment2(delay_steps=30)
    assert list(task.subtasks.items())[:3] == [
        ("observe gesture", 40),
        ("wait", 30),
        ("attend task space", 8),
    ]
    assert len(task.phases) == 178
    assert (task.phases[40:70] == 1).all()
    assert experiment2(delay_steps=0).subtasks == TASK.subtasks


@pytest.mark.parametrize("delay", [0, 30, 200])
def test_a_delay_stops_the_plan_while_the_screen_is_dark(delay):
    task, situation = experiment2(delay_steps=delay), TASK.sample(3)
    plan, without = task.plan(situation), TASK.plan(situation)
    np.testing.assert_array_equal(plan[: 40 + delay], np.tile(task.start, (40 + delay, 1)))
    np.testing.assert_array_equal(plan[40 + delay :], without[40:])
    screen = task.scene(situation).screen
    assert all((screen.frame(step) == DARK_SCREEN).all() for step in range(40, 40 + delay))


def test_a_delay_moves_the_windows_of_the_questions():
    """The gesture is asked for from the same step on, and until the head turns."""
    for question, delayed in zip(
        TASK.questions, experiment2(delay_steps=52).questions, strict=True
    ):
        first, last = (round(148 * share) for share in question.window)
        shift = 0 if question.variable == "indicated_x_m" else 52
        assert [round(200 * share) for share in delayed.window] == [first + shift, last + 52]


def test_the_first_eight_tutored_cases_are_those_of_the_paper():
    cases = TASK.tutored()[:8]
    assert len({case_of(case) for case in cases}) == 8
    for case in cases:
        assert {name: case[name] for name in FIXED} == FIXED


def test_tutored_cases_cover_kinds_poses_and_clips_evenly():
    cases = TASK.tutored()
    assert len(cases) == 72
    assert set(Counter(map(case_of, cases)).values()) == {9}
    poses = Counter((case["indicated_y_m"], case["indicated_yaw_deg"]) for case in cases)
    others = Counter((case["other_y_m"], case["other_yaw_deg"]) for case in cases)
    assert len(poses) == len(others) == 9
    assert set(poses.values()) == set(others.values()) == {8}
    assert len(clips_of(cases)) == 20
    for case in cases:
        TASK.check(case)
    assert cases == experiment2().tutored()


def test_more_poses_give_more_different_situations():
    cases = experiment2(poses=18).tutored()
    without_clip = [tuple(v for k, v in c.items() if k not in {"subject", "take"}) for c in cases]
    assert len(set(without_clip)) == len(cases) == 144


def test_trials_show_new_takes_of_the_tutored_subject():
    trials = [TASK.sample(seed) for seed in range(2000)]
    assert {trial["subject"] for trial in trials} == {"0"}
    assert {trial["take"] for trial in trials} == {str(take) for take in range(10, 110)}
    assert len({case_of(trial) for trial in trials}) == 8
    assert not clips_of(trials) & clips_of(TASK.tutored())
    for trial in trials:
        TASK.check(trial)


def test_trials_can_show_new_subjects():
    task = experiment2(subjects=4, takes=3, trials_show="new-subjects", poses=3)
    trials = [task.sample(seed) for seed in range(2000)]
    assert {case["subject"] for case in task.tutored()} == set("0123")
    assert {trial["subject"] for trial in trials} == {str(subject) for subject in range(4, 54)}
    assert {trial["take"] for trial in trials} == set("012")
    for situation in (*task.tutored(), *trials, *task.corners()):
        task.check(situation)


@pytest.mark.parametrize("shown", ["new-takes", "new-subjects"])
@pytest.mark.parametrize("seeds", [PRACTICE, CORRECTIONS])
def test_practice_and_corrections_show_no_clip_of_trials(shown, seeds):
    task = experiment2(subjects=2, trials_show=shown)
    practised = [task.sample(seed) for seed in seeds[:2000]]
    trials = [task.sample(seed) for seed in range(TRIALS_BELOW - 2000, TRIALS_BELOW)]
    assert not clips_of(practised) & clips_of(trials)
    assert not clips_of(trials) & clips_of(task.tutored())
    assert {situation["subject"] for situation in practised} == {"0", "1"}
    for situation in practised:
        task.check(situation)


def test_corners_combine_the_ends_of_the_ranges_with_every_case():
    corners = TASK.corners()
    assert len(corners) == 8 * 2**4
    assert {corner["take"] for corner in corners} == {"10"}
    assert {corner["indicated_y_m"] for corner in corners} == {0.235, 0.275}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"subjects": 0}, "task.subjects = 0 is not a whole number of at least 1"),
        ({"takes": 2.5}, "task.takes = 2.5 is not a whole number"),
        ({"poses": True}, "task.poses = True is not a whole number"),
        ({"delay_steps": -1}, "task.delay_steps = -1 is not a whole number from 0 to 200"),
        ({"delay_steps": 201}, "task.delay_steps = 201 is not a whole number from 0 to 200"),
        ({"trials_show": "all"}, "task.trials_show = 'all': trials of experiment2 show new-takes"),
        ({"persons": 3}, "task.persons: the task experiment2 has no such option"),
        ({"gestures": "/nowhere"}, "task.gestures: /nowhere: there is no such folder"),
        ({"gestures": 7}, "task.gestures = 7 is no name of a folder"),
        ({"gestures": "g", "takes": 3}, "leave out task.takes"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(UserError, match=message):
        experiment2(**options)


@pytest.mark.parametrize(("place", "side"), [("-0.15", "picture-right"), ("0.07", "picture-left")])
def test_the_screen_shows_the_clip_of_the_indicated_side_and_then_is_dark(place, side):
    screen = TASK.scene({**TASK.sample(1), "indicated_x_m": place, "take": "12"}).screen
    np.testing.assert_array_equal(screen.frames, draw_clip(side, Subject.from_seed(0), 12))
    np.testing.assert_array_equal(screen.frame(39), screen.frames[39])
    assert (screen.frame(40) == DARK_SCREEN).all()
    assert screen.size_m == (1.0, 1.0)


def test_objects_stand_at_their_places_in_different_shades():
    situation = {
        **TASK.sample(2), "indicated_x_m": "0.07", "indicated_kind": "standing",
        "indicated_y_m": 0.27, "indicated_yaw_deg": 10.0, "other_kind": "laying",
    }  # fmt: skip
    boxes = {box.name: box for box in TASK.scene(situation).boxes}
    indicated, other = boxes["indicated_object"], boxes["other_object"]
    assert indicated.pose.position_m == pytest.approx((-0.07, 0.27, 0.075))
    assert 2 * np.arcsin(indicated.pose.quaternion[3]) == pytest.approx(np.deg2rad(-10.0))
    assert other.pose.position_m[0] == pytest.approx(0.15)
    assert indicated.size_m == (0.028, 0.07, 0.15)
    assert other.size_m == (0.028, 0.15, 0.07)
    assert indicated.colour != other.colour


def test_a_users_videos_are_tutored_and_tested(tmp_path):
    for side in ("picture-left", "picture-right"):
        (tmp_path / side).mkdir()
        for number in range(2):
            path = str(tmp_path / side / f"{number}.avi")
            writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 64))
            for _ in range(12):
                writer.write(np.full((64, 64, 3), 100 + 50 * number, dtype=np.uint8))
            writer.release()
    task = experiment2(gestures=str(tmp_path), poses=1)
    assert {case["take"] for case in task.tutored()} == {"0", "1"}
    trial = {**task.sample(5), "take": "1"}
    assert trial["subject"] == "recorded"
    np.testing.assert_allclose(task.scene(trial).screen.frames, 150, atol=4)
    with pytest.raises(UserError, match="there is no such clip"):
        TASK.scene(trial)


def test_baselines_ignore_the_variables_they_are_blind_to():
    situation = {**TASK.sample(4), "indicated_x_m": "0.07"}
    negative = TASK.baselines["always-negative-x"](situation)
    assert negative["indicated_x_m"] == "-0.15"
    for value in ("kind", "y_m", "yaw_deg"):
        assert negative[f"indicated_{value}"] == situation[f"other_{value}"]
        assert negative[f"other_{value}"] == situation[f"indicated_{value}"]
    assert TASK.baselines["always-positive-x"](situation) == situation
    kinds = TASK.baselines["kind-blind"](situation)
    assert kinds["indicated_kind"] != situation["indicated_kind"]
    assert kinds["indicated_y_m"] == situation["indicated_y_m"]
    middle = TASK.baselines["pose-blind"](situation)
    assert middle["indicated_y_m"] == pytest.approx(0.255)
    assert middle["indicated_yaw_deg"] == 0.0
    assert middle["indicated_kind"] == situation["indicated_kind"]
    for belief in (TASK.baselines[name] for name in TASK.baselines if name != "last-gesture"):
        TASK.check(belief(situation))


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4, 1000])
def test_last_gesture_takes_the_side_of_the_situation_with_the_seed_before(seed):
    """Only the side is remembered: objects, kinds and poses are the real ones."""
    before = TASK.sample(abs(seed - 1))["indicated_x_m"]
    policy = make_policy("last-gesture", TASK)
    for situation in (TASK.sample(seed), {**TASK.sample(seed), "indicated_x_m": "0.07"}):
        policy.begin(situation, seed)
        actions = np.stack([policy.step(DARK) for _ in TASK.phases])
        side = "negative" if before == "-0.15" else "positive"
        assumed = TASK.baselines[f"always-{side}-x"](situation)
        np.testing.assert_array_equal(actions, TASK.plan(assumed))


def test_last_gesture_is_right_in_half_of_the_situations():
    sides = [TASK.sample(seed)["indicated_x_m"] for seed in range(400)]
    right = sum(before == now for before, now in itertools.pairwise(sides))
    assert 160 < right < 240


def test_a_blank_screen_hides_the_clip_and_nothing_else():
    """The screen's pixels differ between clips; outside them all pictures are the same."""
    simulator = make_simulator(SimulatorConfig())
    tutor, blind = make_policy("tutor", TASK), TASK.blinded["blank-screen"]
    played = [
        play(simulator, TASK, tutor, TASK.tutored()[number], seed=1, kind=Kind.TRIAL).images
        for number in (0, 1)
    ]
    simulator.close()
    one, other = (
        np.stack([blind(step, image) for step, image in enumerate(images)]) for images in played
    )
    assert (played[0][:40] != played[1][:40]).any()
    np.testing.assert_array_equal(one[:40], other[:40])
    np.testing.assert_array_equal(one[40:], played[0][40:])
    margin = (one[:40] == played[0][:40]).all(axis=(0, 1))
    assert margin[:4].all()
    assert margin[-5:].all()


@pytest.fixture(scope="module")
def physics():
    simulator = make_simulator(SimulatorConfig(render=False))
    yield simulator
    simulator.close()


def outcome(simulator, policy, situation, task=TASK):
    played = make_policy(policy, task)
    return play(simulator, task, played, situation, seed=1, kind=Kind.TRIAL).outcome


@pytest.mark.parametrize("number", range(8))
def test_the_tutor_lifts_the_indicated_object_in_every_case(physics, number):
    assert outcome(physics, "tutor", TASK.tutored()[number]).precise


def test_the_tutor_lifts_the_indicated_object_after_a_delay(physics):
    assert outcome(physics, "tutor", TASK.tutored()[0], experiment2(delay_steps=60)).precise


@pytest.mark.slow
@pytest.mark.parametrize("number", range(128))
def test_the_tutor_is_precise_at_every_corner(physics, number):
    assert outcome(physics, "tutor", TASK.corners()[number]).precise


def test_the_wrong_side_lifts_the_wrong_object(physics):
    situation = TASK.tutored()[1]
    assert situation["indicated_x_m"] == "0.07"
    missed = outcome(physics, "always-negative-x", situation)
    assert not missed.lenient
    assert missed.reason == "wrong_object"


def test_the_other_kinds_grasp_is_not_strict(physics):
    for number in (0, 6):
        assert not outcome(physics, "kind-blind", TASK.tutored()[number]).strict
