"""What pre-training asks about a situation, and the classes of the answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learner.checkpoint import Classes
from proto.episode import Episode
from proto.errors import UserError
from proto.variables import Question, Value


@dataclass(frozen=True)
class Asked:
    """A question with the classes of its answer.

    Attributes:
        variable: name of the variable that is asked for.
        classes: centres of the classes of a continuous variable, choices of a discrete one.
        window: in which part of a sequence it is asked, see `proto.variables.Question`.
    """

    variable: str
    classes: Classes
    window: tuple[float, float]

    @classmethod
    def of(cls, question: Question, episodes: Sequence[Episode]) -> Asked:
        """A question with classes that cover the situations of some episodes evenly.

        Raises:
            UserError: the question does not fit the kind of the variable.
        """
        values = [episode.situation[question.variable] for episode in episodes]
        choices = sorted({value for value in values if isinstance(value, str)})
        numbers = [value for value in values if not isinstance(value, str)]
        if choices and not numbers and question.classes is None:
            return cls(question.variable, tuple(choices), question.window)
        if numbers and not choices and question.classes is not None:
            return cls(question.variable, _centres(numbers, question.classes), question.window)
        raise UserError(
            f"the question about {question.variable} does not fit its values, such as"
            f" {values[0]!r}: a continuous variable needs a number of classes, a discrete one none"
        )


def soft_label(value: Value, classes: Classes) -> NDArray[np.float32]:
    """(classes,) one for the class of a value; between two centres, shared by both.

    Raises:
        UserError: the value is a choice that is none of the classes.
    """
    if isinstance(value, str):
        if value not in classes:
            raise UserError(
                f"pre-training knows the choices {', '.join(map(str, classes))}, not {value!r}"
            )
        return np.array([value == each for each in classes], np.float32)
    centres = np.asarray(classes, np.float64)
    shares = [np.interp(value, centres, only) for only in np.eye(len(centres))]
    return np.asarray(shares, np.float32)


def _centres(values: Sequence[float], count: int) -> tuple[float, ...]:
    """Centres of classes, evenly from the lowest to the highest value."""
    low, high = min(values), max(values)
    centres = np.linspace(low, max(high, low + 1e-6), count)  # centres must differ
    return tuple(centres.tolist())
