"""An episode fits a run only if it is one that the run's task can give."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fitting import fitting_fields, task_called
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from proto.acceptance import misfit, same_situation
from proto.episode import Episode
from proto.variables import Situation

TASK = task_called("experiment1")
SITUATION = dict(TASK.tutored()[0])


@pytest.fixture(scope="module")
def fitting(make_episode: Callable[..., Episode]) -> Episode:
    return make_episode(len(TASK.phases), situation=SITUATION, **fitting_fields())


@pytest.mark.parametrize("name", ["experiment1", "experiment2", "reaching"])
def test_demonstrations_of_each_task_fit(name: str, make_episode: Callable[..., Episode]) -> None:
    task = task_called(name)
    shown = make_episode(
        len(task.phases), situation=dict(task.tutored()[0]), **fitting_fields(name)
    )
    assert misfit(shown, task, 0.1) == ""
    if name != "experiment1":
        assert misfit(shown, TASK, 0.1)


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ({"situation": {}}, "a situation has"),
        ({"situation": {**SITUATION, "mood": 1.0}}, "a situation has"),
        ({"situation": {**SITUATION, "object_y_m": "left"}}, "is not a number"),
        ({"situation": {**SITUATION, "object_y_m": float("nan")}}, "lies outside"),
        ({"situation": {**SITUATION, "object_y_m": 1e12}}, "lies outside"),
        ({"control_period_s": 0.05}, "0.05 s, not 0.1 s"),
        ({"control_period_s": float("nan")}, "nan s"),
        ({"phases": TASK.phases[:1]}, "it has 1 steps"),
        ({"phases": np.resize(TASK.phases, 900)}, "it has 900 steps"),
        ({"phases": TASK.phases[::-1]}, "its phases"),
        ({"targets": np.full((124, 11), np.nan, np.float32)}, "its targets"),
        ({"targets": np.full((124, 11), 1e12, np.float32)}, "its targets"),
        ({"actions": np.full((124, 11), -60, np.float32)}, "its actions"),
    ],
)
def test_what_does_not_fit_is_named(fitting: Episode, wrong: dict[str, Any], problem: str) -> None:
    assert misfit(fitting, TASK, 0.1) == ""
    assert problem in misfit(replace(fitting, **wrong), TASK, 0.1)


SITUATIONS: st.SearchStrategy[Situation] = st.dictionaries(
    st.sampled_from([*SITUATION, "else"]), st.floats() | st.text(max_size=5), max_size=5
)


@given(situation=SITUATIONS, other=SITUATIONS, steps=st.integers(1, 200), period=st.floats())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_comes_gets_an_answer(
    fitting: Episode, situation: Situation, other: Situation, steps: int, period: float
) -> None:
    episode = replace(
        fitting,
        situation=situation,
        phases=np.resize(TASK.phases, steps),
        control_period_s=period,
    )
    fits = misfit(episode, TASK, 0.1) == ""
    assert not fits or steps == len(TASK.phases)
    assert same_situation(situation, other) == same_situation(other, situation)
