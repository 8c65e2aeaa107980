"""The interface of tasks. A task is one class in a folder of its own.

A task defines its variables and phases, the scene of each situation, the tutor's plan for it, and
the judge of an episode. Code outside the task's folder does not depend on what the task is about.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from actors.simulator import Pose, Scene, StepReport
from proto.config import TaskConfig
from proto.episode import Outcome
from proto.errors import UserError
from proto.variables import (
    Continuous,
    Question,
    Situation,
    Value,
    Variable,
    check_situation,
    sample_situation,
)

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Belief = Callable[[Situation], Situation]
"""Maps the real situation to the situation that a baseline assumes."""
Blinding = Callable[[int, Image], Image]
"""Maps a control step, from 0, and the picture (48, 64) uint8 to the picture that a policy sees."""


@dataclass(frozen=True)
class Recollection:
    """A belief that depends on the episode before, as if a baseline remembered it.

    Attributes:
        assume: maps the real situation and the situation of the episode before to the situation
            that the baseline assumes.
    """

    assume: Callable[[Situation, Situation], Situation]


class Judge(Protocol):
    """Observes one episode and judges its outcome."""

    def watch(self, report: StepReport, joints_deg: Array, bodies: Mapping[str, Pose]) -> None:
        """Record one control step after it was simulated.

        Args:
            report: the contacts during the step.
            joints_deg: (18,) measured joints after the step.
            bodies: true poses after the step, by name.
        """

    def outcome(self) -> Outcome:
        """Judge the episode; to be called after its last step was recorded."""


@dataclass(frozen=True)
class GraspError:
    """A position or orientation error of the grasp that figures show.

    Attributes:
        name: its name in tables and JSON.
        label: axis label with the unit.
        allowed: approximate largest magnitude of the error in a precise grasp.
        measure: returns the error, given an outcome and its situation.
        variable: the variable whose error in perception causes this error; None if there is no
            such variable. Figures use it to show whether a policy prefers tutored values.
        per_unit: change of the error for a change of that variable by one unit.
    """

    name: str
    label: str
    allowed: float
    measure: Callable[[Outcome, Situation], float]
    variable: str | None = None
    per_unit: float = 1.0


@dataclass(frozen=True)
class MemoryProbe:
    """How it can be tested whether a network remembers a variable.

    Attributes:
        phase: name of the last phase in which what is seen and done is the same for all choices.
        variable: the discrete variable that must be remembered until then.
        output: name of the action value (see `proto.body`) that tells the choice when the next
            phase is over.
    """

    phase: str
    variable: str
    output: str


@dataclass(frozen=True)
class MeasuredBaseline:
    """What the tutor or a baseline achieves in situations that were not tutored, as measured once.

    Attributes:
        name: its name: `tutor`, or one of `Task.baselines`.
        backend: name of the simulator.
        trials: number of trials.
        lenient, strict, precise: number of successes in the three readings.
    """

    name: str
    backend: str
    trials: int
    lenient: int
    strict: int
    precise: int


@dataclass(frozen=True)
class FigureWords:
    """Labels and errors of a task that figures show.

    Attributes:
        reasons: label of each reason of an outcome, from the least to the most serious.
        errors: the errors of the grasp.
        in_place: returns whether the object had not moved before the hand closed. Errors of the
            grasp are meaningful only then.
        memory: how it can be tested whether a network remembers a variable; None if nothing must
            be remembered.
        baselines: what the tutor and the baselines achieve, to compare policies with.
        published: published number of lenient successes and of trials by time constant of the PFC;
            empty if nothing was published.
    """

    reasons: Mapping[str, str]
    errors: tuple[GraspError, ...] = ()
    in_place: Callable[[Outcome], bool] = lambda _: True
    memory: MemoryProbe | None = None
    baselines: tuple[MeasuredBaseline, ...] = ()
    published: Mapping[float, tuple[int, int]] = field(default_factory=dict)


class Task(ABC):
    """A task. Subclasses define the class attributes and the abstract methods.

    Attributes:
        name: its name in configurations and files: the name of a built-in task, or
            `package.module:Class`.
        variables: the variables that differ between situations.
        subtasks: number of control steps of each phase by name, in the order of the phases.
        start: (11,) the action whose posture every episode starts from (see `proto.body`).
        questions: the questions about the variables that pre-training learns to answer; empty if
            the task cannot be used for pre-training.
        distractors: names of variables that the tutor's actions do not depend on. Sequences that
            differ in them may be mixed (see `learner.training.interpolation`).
        baselines: by name, the situation that a baseline assumes. A baseline executes the tutor's
            plan for this situation.
        blinded: by name, how the pictures of a policy are changed so that something is hidden from
            it. `NAME:POLICY` is the policy that sees the changed pictures.
        figure_words: labels and errors for figures.
        options: names of the task's options in the section `task` of a configuration, besides name
            and attention.
        pushed_variable: name of the continuous variable, in metres, that changes when the object is
            pushed; empty if no disturbance can push it. The *object* of a disturbance is the first
            box of the scene that can move.
        turned_variable: name of the continuous variable, in degrees, that changes when the object
            is turned; empty if no disturbance can turn it.
        disturbed_phase: name of the phase in which a disturbance pushes or turns the object, or
            knocks the arm: after the object is looked at, and before the hand is near. If empty, it
            happens in the middle third of an episode.
        attention: `active`, or `fixed`: neck and focus stay as in `start`, whatever the policy
            commands.
    """

    name: str
    variables: tuple[Variable, ...]
    subtasks: Mapping[str, int]
    start: Array
    questions: tuple[Question, ...] = ()
    distractors: frozenset[str] = frozenset()
    baselines: ClassVar[Mapping[str, Belief | Recollection]] = {}
    blinded: ClassVar[Mapping[str, Blinding]] = {}
    figure_words: ClassVar[FigureWords] = FigureWords({})
    options: ClassVar[frozenset[str]] = frozenset()
    pushed_variable: ClassVar[str] = ""
    turned_variable: ClassVar[str] = ""
    disturbed_phase: ClassVar[str] = ""

    def __init__(self, config: TaskConfig) -> None:
        """Make the task from the section `task` of a configuration.

        Raises:
            UserError: the section contains an option that the task does not have.
        """
        self.attention = config.attention
        if unknown := config.options.keys() - self.options:
            known = ", ".join(sorted({"name", "attention", *self.options}))
            raise UserError(
                f"task.{min(unknown)}: the task {self.name} has no such option; it has {known}"
            )

    @abstractmethod
    def tutored(self) -> Sequence[Situation]:
        """Return the tutored situations, always in the same order."""

    @abstractmethod
    def scene(self, situation: Situation) -> Scene:
        """Return the scene of a situation, for the simulator."""

    @abstractmethod
    def plan(self, situation: Situation) -> Array:
        """Return the tutor's actions (T, 11) in a situation, see `proto.body`."""

    @abstractmethod
    def judge(self, situation: Situation) -> Judge:
        """Return a judge for one episode in a situation."""

    @property
    def phase_names(self) -> tuple[str, ...]:
        """Names of the phases, in their order."""
        return tuple(self.subtasks)

    @cached_property
    def phases(self) -> NDArray[np.uint8]:
        """Index (T,) uint8 of the phase of each control step."""
        return np.repeat(
            np.arange(len(self.subtasks), dtype=np.uint8), list(self.subtasks.values())
        )

    def sample(self, seed: int) -> Situation:
        """Draw a random situation; the same seed gives the same situation."""
        return sample_situation(self.variables, seed)

    def check(self, situation: Situation) -> None:
        """Check that a situation has a valid value for each variable.

        Raises:
            UserError: a value is missing, unknown or not valid.
        """
        check_situation(situation, self.variables, self.name)

    def corners(self) -> Sequence[Situation]:
        """Return the situations at the corners of the variables' ranges.

        They are all combinations of the minimum and maximum of each continuous variable and the
        choices of each discrete variable.
        """
        return corners_of(self.variables)


def corners_of(variables: Sequence[Variable]) -> Sequence[Situation]:
    """Combine the ends of each continuous variable with the choices of each discrete one."""
    ends: list[Sequence[Value]] = [
        (variable.minimum, variable.maximum)
        if isinstance(variable, Continuous)
        else variable.choices
        for variable in variables
    ]
    names = [variable.name for variable in variables]
    return [dict(zip(names, values, strict=True)) for values in product(*ends)]
