"""Experiment II of the paper (section 4.3): grasp the object at which a person points."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Final

import numpy as np

from actors.simulator import Scene
from actors.tasks.contract import Array, Task, corners_of
from actors.tasks.experiment2 import world
from actors.tasks.experiment2.baselines import BASELINES, BLINDED
from actors.tasks.experiment2.clips import OPTIONS, Clips, clips_of, whole_number
from actors.tasks.experiment2.figure_words import FIGURE_WORDS
from actors.tasks.experiment2.judge import Experiment2Judge
from actors.tasks.experiment2.plan import GAZE_STEPS, plan
from actors.tasks.experiment2.setting import (
    INDICATED_X,
    KINDS,
    PLACES,
    SUBJECT,
    TAKE,
    Place,
    Setting,
)
from proto.config import TaskConfig
from proto.errors import UserError
from proto.seeds import TRIALS_BELOW
from proto.variables import (
    Continuous,
    Discrete,
    Question,
    Situation,
    Variable,
    sample_situation,
)

TUTORED_POSES: Final = tuple(
    (y_m, yaw_deg)
    for y_m in (sum(world.Y_RANGE_M) / 2, *world.Y_RANGE_M)
    for yaw_deg in (0.0, *world.YAW_RANGE_DEG)
)
"""Y and yaw of tutored objects, the middle of the ranges first."""
_CLIP_SEED: Final = 17
_GESTURE_SEEN: Final = 20
"""Control step from which pre-training asks where the person points."""


class Experiment2(Task):
    """Experiment II. Trials are uniform inside the ranges, with clips that were not tutored.

    Options: those of `actors.tasks.experiment2.clips.clips_of`; `poses` (9), the number of tutored
    poses of the objects in each of the paper's eight cases; and `delay_steps` (0), the number of
    control steps after the gesture in which the robot looks at the dark screen and waits.
    """

    name = "experiment2"
    start = world.START
    distractors = frozenset({"other_y_m", "other_yaw_deg", SUBJECT, TAKE})
    baselines = BASELINES
    blinded = BLINDED
    figure_words = FIGURE_WORDS
    options = OPTIONS
    pushed_variable = "indicated_y_m"
    turned_variable = "indicated_yaw_deg"
    disturbed_phase = "reach above object"

    def __init__(self, config: TaskConfig) -> None:
        """Make the task as the configuration's section `task` says.

        Raises:
            UserError: an option is unknown, has a wrong value, or the videos cannot be used.
        """
        super().__init__(config)
        self._clips = clips_of(config.options, self.name)
        self._poses = whole_number(config.options, "poses", len(TUTORED_POSES))
        self.subtasks = world.delayed_subtasks(
            whole_number(config.options, "delay_steps", 0, least=0, most=world.LONGEST_DELAY)
        )
        self.questions = _questions(self.subtasks)
        self.variables = _variables(self._clips.subjects, self._clips.takes)
        trials, practice = self._clips.trials, self._clips.practice
        self._trial_variables = _variables(trials.subjects, trials.takes)
        self._practice_variables = _variables(practice.subjects, practice.takes)

    def tutored(self) -> Sequence[Situation]:
        """The paper's eight cases, first with both objects in the middle, then in other poses."""
        clips = {place: _tutored_clips(self._clips, place) for place in PLACES}
        situations: list[Situation] = []
        for number in range(self._poses):
            indicated, other = _pose(number), _pose(4 * number + number // len(TUTORED_POSES))
            for kind, other_kind, place in product(KINDS, KINDS, PLACES):
                subject, take = next(clips[place])
                values = (place, kind, *indicated, other_kind, *other, subject, take)
                names = (variable.name for variable in self.variables)
                situations.append(dict(zip(names, values, strict=True)))
        return situations

    def sample(self, seed: int) -> Situation:
        """A situation of a trial, or of practice or a correction if the seed is one of those.

        The same seed gives the same situation. Practice shows no clip that trials show.
        """
        trial = seed < TRIALS_BELOW
        return sample_situation(self._trial_variables if trial else self._practice_variables, seed)

    def corners(self) -> Sequence[Situation]:
        """The situations at the ends of all ranges, for each case of the paper; one clip a side."""
        trials = self._clips.trials
        return corners_of(_variables(trials.subjects[:1], trials.takes[:1]))

    def scene(self, situation: Situation) -> Scene:
        """Table, objects, and the screen with the situation's clip.

        Raises:
            UserError: there is no such clip.
        """
        setting = Setting.of(situation)
        try:
            clip = self._clips.library.clip(setting.side, setting.subject, setting.take)
        except ValueError as error:
            raise UserError(
                f"{self.name}: there is no such clip: {error}. Videos of your own are found with"
                f" --set task.name={self.name} --set task.gestures=FOLDER."
            ) from error
        return world.scene(setting, clip)

    def plan(self, situation: Situation) -> Array:
        """Return the tutor's actions (T, 11); T is 148 without a delay."""
        return plan(situation, self.subtasks)

    def judge(self, situation: Situation) -> Experiment2Judge:
        """A judge for one episode of a situation."""
        return Experiment2Judge(situation, self.subtasks)


def _questions(subtasks: Mapping[str, int]) -> tuple[Question, ...]:
    """Return the questions of pre-training, each with its window in the sequence.

    The indicated place is asked for until the head turns to the object, because later pictures show
    the answer. Kind and pose are asked for while the object is in view.
    """
    total, begins = sum(subtasks.values()), world.first_steps(subtasks)

    def window(first: int, last: int) -> tuple[float, float]:
        return (first / total, last / total)

    kind_seen = begins["attend object"] + GAZE_STEPS
    pose = window(begins["reach above object"] + GAZE_STEPS, begins["lift"])
    return (
        Question(INDICATED_X, window=window(_GESTURE_SEEN, begins["attend object"])),
        Question("indicated_kind", window=window(kind_seen, begins["approach"])),
        Question("indicated_y_m", 3, window=pose),
        Question("indicated_yaw_deg", 3, window=pose),
    )


def _variables(subjects: tuple[str, ...], takes: tuple[str, ...]) -> tuple[Variable, ...]:
    return (
        Discrete(INDICATED_X, PLACES),
        Discrete("indicated_kind", KINDS),
        Continuous("indicated_y_m", *world.Y_RANGE_M, "m"),
        Continuous("indicated_yaw_deg", *world.YAW_RANGE_DEG, "deg"),
        Discrete("other_kind", KINDS),
        Continuous("other_y_m", *world.Y_RANGE_M, "m"),
        Continuous("other_yaw_deg", *world.YAW_RANGE_DEG, "deg"),
        Discrete(SUBJECT, subjects),
        Discrete(TAKE, takes),
    )


def _pose(number: int) -> tuple[float, float]:
    return TUTORED_POSES[number % len(TUTORED_POSES)]


def _tutored_clips(clips: Clips, place: Place) -> Iterator[tuple[str, str]]:
    """Subject and take for one tutored situation after the other, in a random order that is fixed.

    All clips of a side come before one comes again, and kinds and poses tell nothing about them.
    """
    random = np.random.default_rng([_CLIP_SEED, PLACES.index(place)])
    pairs = list(product(clips.tutored.subjects, clips.tutored.takes))
    while True:
        for index in random.permutation(len(pairs)):
            yield pairs[index]
