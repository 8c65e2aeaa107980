"""The variables of a task: what differs from one episode to the next, with types and ranges.

A *situation* gives each variable a value. The value of a continuous variable is a float, the value
of a discrete variable is a str, one of its named choices. Whoever has a situation without its task
can therefore still tell the two kinds apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np

from proto.codec import NumberOrText, Table
from proto.errors import UserError

Value = float | str
"""The value of a variable: a float for a continuous one, a str for a discrete one."""
Situation = Mapping[str, Value]
"""The value of each variable, by name."""
SituationField = Annotated[Situation, Table(NumberOrText(), most=32)]
"""A situation as a field of a message."""

_ROUNDING: Final = 1e-9


@dataclass(frozen=True)
class Continuous:
    """A variable whose value is a number.

    Attributes:
        name: its name, which ends in the unit where there is one: `object_y_m`.
        minimum: smallest value.
        maximum: largest value.
        unit: unit of the values, such as `m` or `deg`; empty if they have none.
    """

    name: str
    minimum: float
    maximum: float
    unit: str = ""

    def problem(self, value: object) -> str:
        """Why a value is not one of this variable's; empty if it is."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            return f"{self.name} = {value!r} is not a number"
        if not self.minimum - _ROUNDING <= value <= self.maximum + _ROUNDING:
            return f"{self.name} = {value} lies outside {self.minimum} .. {self.maximum}"
        return ""

    def draw(self, random: np.random.Generator) -> Value:
        """A value, uniform inside the range."""
        return float(random.uniform(self.minimum, self.maximum))

    def parse(self, text: str) -> Value:
        """The value that a text names; ValueError if it is not a number."""
        return float(text)


@dataclass(frozen=True)
class Discrete:
    """A variable whose value is one of some named choices.

    Attributes:
        name: its name.
        choices: names of the choices, in the order in which they are listed and drawn.
    """

    name: str
    choices: tuple[str, ...]

    def problem(self, value: object) -> str:
        """Why a value is not one of this variable's; empty if it is."""
        if value in self.choices:
            return ""
        return f"{self.name} = {value!r} is none of {', '.join(self.choices)}"

    def draw(self, random: np.random.Generator) -> Value:
        """A choice; all are equally likely."""
        return self.choices[int(random.integers(len(self.choices)))]

    def parse(self, text: str) -> Value:
        """The value that a text names; `problem` tells whether it is a choice."""
        return text


Variable = Continuous | Discrete


@dataclass(frozen=True)
class Question:
    """What pre-training asks about a variable (delayed-response classifier, paper, section 3.3).

    Attributes:
        variable: name of the variable.
        classes: number of classes into which the values of a continuous variable are divided;
            None for a discrete variable, whose choices are the classes.
        window: in which part of a sequence the answer is asked for: first and last moment as
            shares of its length, 0..1.
    """

    variable: str
    classes: int | None = None
    window: tuple[float, float] = (0.75, 1.0)


def check_situation(situation: Situation, variables: Sequence[Variable], task: str) -> None:
    """Refuse a situation that does not give each variable a value of its own.

    Raises:
        UserError: a variable is missing, unknown, or has a value that it cannot have.
    """
    names = [variable.name for variable in variables]
    if set(situation) != set(names):
        raise UserError(
            f"{task}: a situation has {', '.join(names)}; this one has {', '.join(situation)}"
        )
    for variable in variables:
        if problem := variable.problem(situation[variable.name]):
            raise UserError(f"{task}: {problem}")


def sample_situation(variables: Sequence[Variable], seed: int) -> Situation:
    """Draw a situation; the same seed gives the same one."""
    random = np.random.default_rng(seed)
    return {variable.name: variable.draw(random) for variable in variables}


def parse_situation(text: str, variables: Sequence[Variable], task: str) -> Situation:
    """Read a situation written as `NAME=VALUE,NAME=VALUE,...`.

    Raises:
        UserError: it is written otherwise, or it is no situation of the task.
    """
    by_name = {variable.name: variable for variable in variables}
    situation: dict[str, Value] = {}
    for part in text.split(","):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not equals:
            raise UserError(f"--situation {text}: write NAME=VALUE,NAME=VALUE,...")
        try:
            situation[name] = by_name[name].parse(value) if name in by_name else value
        except ValueError:
            raise UserError(f"--situation {text}: {value!r} is not a number for {name}") from None
    check_situation(situation, variables, task)
    return situation


def number_of(situation: Situation, name: str) -> float:
    """The value of a continuous variable.

    Raises:
        KeyError: the situation has no such variable.
        TypeError: the variable is discrete.
    """
    value = situation[name]
    if isinstance(value, str):
        raise TypeError(f"{name} = {value!r} is a choice, not a number")
    return value


def situation_text(situation: Situation) -> str:
    """A situation for people, such as `object_y_m 0.25, indicated left`."""
    return ", ".join(
        f"{name} {value}" if isinstance(value, str) else f"{name} {value:.4g}"
        for name, value in situation.items()
    )
