"""What a task is. A task is one class in a folder of its own; everything it knows stays there.

A task names its variables and phases, gives the scene of each situation, plans what the tutor does
in it, and judges how an episode went. Nothing outside the task's folder knows what it is about.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
Belief = Callable[[Situation], Situation]
"""What a policy without eyes takes a situation for."""


class Judge(Protocol):
    """Watches one episode and reads its success."""

    def watch(self, report: StepReport, joints_deg: Array, bodies: Mapping[str, Pose]) -> None:
        """Take note of one control step that has just been run.

        Args:
            report: what touched what during the step.
            joints_deg: (18,) measured joints after the step.
            bodies: true poses after the step, by name.
        """

    def outcome(self) -> Outcome:
        """How the episode went, once its last step was watched."""


@dataclass(frozen=True)
class GraspError:
    """An error of a policy at the moment of the grasp, as figures show it.

    Attributes:
        name: its name in tables and JSON.
        label: what an axis calls it, with its unit.
        allowed: about how large it may be in a precise grasp.
        measure: reads it from an outcome and its situation.
        variable: the variable of which it shows whether a policy snaps to tutored values; None if
            it shows that of none.
        per_unit: how much of the error corresponds to one unit of that variable.
    """

    name: str
    label: str
    allowed: float
    measure: Callable[[Outcome, Situation], float]
    variable: str | None = None
    per_unit: float = 1.0


@dataclass(frozen=True)
class FigureWords:
    """What figures must know of a task.

    Attributes:
        reasons: what to call each reason of failure, from the least to the most serious.
        errors: the errors at the grasp.
        in_place: whether the object was still in its place when the hand closed, so that the errors
            at the grasp mean something.
    """

    reasons: Mapping[str, str]
    errors: tuple[GraspError, ...] = ()
    in_place: Callable[[Outcome], bool] = lambda _: True


class Task(ABC):
    """A task; subclasses give the class attributes and the abstract methods.

    Attributes:
        name: what it is called in configurations and files: the name of a built-in task, or
            `package.module:Class`.
        variables: what differs between situations.
        subtasks: control steps of each phase, by the phase's name, in their order.
        start: (11,) the action whose posture every episode starts from (see `proto.body`).
        questions: what pre-training asks about the variables; empty if it cannot be pre-trained on.
        baselines: what each baseline takes a situation for, by the baseline's name. A baseline does
            what the tutor would do in the situation that it believes in.
        figure_words: what figures must know.
        options: names of the options that the task takes in the section `task` of a configuration,
            besides name and attention.
        attention: if `fixed`, neck and focus stay as in `start`, whatever the policy says.
    """

    name: str
    variables: tuple[Variable, ...]
    subtasks: Mapping[str, int]
    start: Array
    questions: tuple[Question, ...] = ()
    baselines: ClassVar[Mapping[str, Belief]] = {}
    figure_words: ClassVar[FigureWords] = FigureWords({})
    options: ClassVar[frozenset[str]] = frozenset()

    def __init__(self, config: TaskConfig) -> None:
        """Make the task as the configuration's section `task` says.

        Raises:
            UserError: the section holds an option that the task does not have.
        """
        self.attention = config.attention
        if unknown := config.options.keys() - self.options:
            known = ", ".join(sorted({"name", "attention", *self.options}))
            raise UserError(
                f"task.{min(unknown)}: the task {self.name} has no such option; it has {known}"
            )

    @abstractmethod
    def tutored(self) -> Sequence[Situation]:
        """The situations that are tutored, always in the same order."""

    @abstractmethod
    def scene(self, situation: Situation) -> Scene:
        """What the simulator plays in a situation."""

    @abstractmethod
    def plan(self, situation: Situation) -> Array:
        """What the tutor does in a situation: actions (T, 11), see `proto.body`."""

    @abstractmethod
    def judge(self, situation: Situation) -> Judge:
        """A judge for one episode of a situation."""

    @property
    def phase_names(self) -> tuple[str, ...]:
        """Names of the phases, in their order."""
        return tuple(self.subtasks)

    @cached_property
    def phases(self) -> NDArray[np.uint8]:
        """(T,) uint8, index of the phase of each control step."""
        return np.repeat(
            np.arange(len(self.subtasks), dtype=np.uint8), list(self.subtasks.values())
        )

    def sample(self, seed: int) -> Situation:
        """A situation that was drawn from the variables; the same seed gives the same one."""
        return sample_situation(self.variables, seed)

    def check(self, situation: Situation) -> None:
        """Raise UserError unless the situation gives each variable a value that it can have."""
        check_situation(situation, self.variables, self.name)

    def corners(self) -> Sequence[Situation]:
        """The situations at the ends of all ranges, for each choice of the discrete variables."""
        ends: list[Sequence[Value]] = [
            (variable.minimum, variable.maximum)
            if isinstance(variable, Continuous)
            else variable.choices
            for variable in self.variables
        ]
        names = [variable.name for variable in self.variables]
        return [dict(zip(names, values, strict=True)) for values in product(*ends)]
