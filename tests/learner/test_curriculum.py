"""Every case is shown once, the clean executions first."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from learner.curriculum import Curriculum
from proto.config import Config, LearnerConfig, TutorConfig
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.messages import TutoringCase

MakeEpisode = Callable[..., Episode]


def curriculum(cases: tuple[int, ...] | None = (0, 7), repeats: int = 2) -> Curriculum:
    config = Config(learner=LearnerConfig(cases=cases), tutor=TutorConfig(repeats=repeats))
    return Curriculum(config, tutored_cases=45)


def test_clean_executions_come_first() -> None:
    plan = curriculum()
    assert plan.size == 4
    assert [plan.next_case("a") for _ in range(5)] == [
        TutoringCase(0, 0),
        TutoringCase(7, 0),
        TutoringCase(0, 1),
        TutoringCase(7, 1),
        None,
    ]


def test_all_cases_unless_some_are_named() -> None:
    assert curriculum(cases=None, repeats=4).size == 180


def test_what_was_shown_is_not_handed_out_again(make_episode: MakeEpisode) -> None:
    plan = curriculum()
    shown = make_episode(kind=Kind.TUTORING, seed=TutoringCase(7, 1).seed)
    assert plan.wants(shown)
    plan.shown([shown, shown])
    assert not plan.wants(shown)
    assert plan.missing == 3
    assert TutoringCase(7, 1) not in [plan.next_case("a") for _ in range(4)]


def test_the_case_of_an_actor_that_is_gone_is_handed_out_again() -> None:
    plan = curriculum()
    assert plan.next_case("mortal") == TutoringCase(0, 0)
    assert plan.next_case("other") == TutoringCase(7, 0)
    plan.release("mortal")
    assert plan.next_case("other") == TutoringCase(0, 0)


def test_only_the_tasks_own_tutored_cases_are_wanted(make_episode: MakeEpisode) -> None:
    plan = curriculum()
    assert not plan.wants(make_episode(kind=Kind.TRIAL, seed=0))
    assert not plan.wants(make_episode(kind=Kind.TUTORING, seed=0, task="experiment9"))
    assert not plan.wants(make_episode(kind=Kind.TUTORING, seed=1000))
    assert plan.wants(make_episode(kind=Kind.TUTORING, seed=0))


def test_a_case_that_there_is_not_is_named() -> None:
    with pytest.raises(UserError, match=r"no case 45; the task experiment1 has .* 0 to 44"):
        curriculum(cases=(3, 45))
