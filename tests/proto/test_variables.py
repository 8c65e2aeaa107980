"""Situations of typed variables are checked, drawn and read from a command line."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from proto.errors import UserError
from proto.variables import (
    Continuous,
    Discrete,
    Situation,
    check_situation,
    number_of,
    parse_situation,
    sample_situation,
    situation_text,
)

VARIABLES = (
    Continuous("object_y_m", 0.2, 0.3, "m"),
    Discrete("kind", ("standing", "laying")),
)


@given(st.integers(0, 2**63 - 1))
def test_a_random_situation_is_valid_and_repeats_with_its_seed(seed: int) -> None:
    situation = sample_situation(VARIABLES, seed)
    check_situation(situation, VARIABLES, "task")
    assert situation == sample_situation(VARIABLES, seed)


def test_all_choices_are_drawn() -> None:
    drawn = [sample_situation(VARIABLES, seed)["kind"] for seed in range(100)]
    assert 30 < drawn.count("laying") < 70


@given(st.floats(0.2, 0.3), st.sampled_from(("standing", "laying")))
def test_a_written_situation_is_read_back_unchanged(y: float, kind: str) -> None:
    read = parse_situation(f"kind={kind}, object_y_m={y!r}", VARIABLES, "task")
    assert read == {"object_y_m": y, "kind": kind}


@pytest.mark.parametrize(
    ("situation", "problem"),
    [
        ({"object_y_m": 0.25}, "task: a situation has object_y_m, kind; this one has object_y_m"),
        ({"object_y_m": 0.31, "kind": "laying"}, r"object_y_m = 0.31 lies outside 0.2 .. 0.3"),
        ({"object_y_m": float("nan"), "kind": "laying"}, "object_y_m = nan lies outside"),
        ({"object_y_m": "near", "kind": "laying"}, "object_y_m = 'near' is not a number"),
        ({"object_y_m": True, "kind": "laying"}, "object_y_m = True is not a number"),
        ({"object_y_m": 0.25, "kind": "lying"}, "kind = 'lying' is none of standing, laying"),
        ({"object_y_m": 0.25, "kind": 1.0}, "kind = 1.0 is none of"),
    ],
)
def test_the_problem_is_named(situation: Situation, problem: str) -> None:
    with pytest.raises(UserError, match=problem):
        check_situation(situation, VARIABLES, "task")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("object_y_m", "write NAME=VALUE"),
        ("", "write NAME=VALUE"),
        ("object_y_m=far,kind=laying", "'far' is not a number for object_y_m"),
        ("object_y_m=0.2,kinds=laying", "a situation has object_y_m, kind"),
    ],
)
def test_a_text_that_cannot_be_parsed_is_refused(text: str, problem: str) -> None:
    with pytest.raises(UserError, match=problem):
        parse_situation(text, VARIABLES, "task")


def test_a_choice_is_not_accepted_as_a_number() -> None:
    situation = {"object_y_m": 0.25, "kind": "laying"}
    assert number_of(situation, "object_y_m") == 0.25
    with pytest.raises(TypeError, match="kind = 'laying' is a choice"):
        number_of(situation, "kind")
    assert situation_text(situation) == "object_y_m 0.25, kind laying"
