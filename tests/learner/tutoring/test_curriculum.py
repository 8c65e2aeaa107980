"""Every case is demonstrated once, executions without noise first."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from learner.tutoring.curriculum import Curriculum
from learner.tutoring.failures import TRIES
from proto.config import Config, LearnerConfig, PretrainingConfig, TutorConfig
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.messages import EpisodeFailed, TutoringCase

MakeEpisode = Callable[..., Episode]


AVAILABLE = {"experiment1": 45, "reaching": 15}


def case(number: int, repeat: int, task: str = "experiment1") -> TutoringCase:
    return TutoringCase(task, number, repeat)


def curriculum(cases: tuple[int, ...] | None = (0, 7), repeats: int = 2) -> Curriculum:
    config = Config(
        learner=LearnerConfig(cases=cases, pretraining=PretrainingConfig(task=None)),
        tutor=TutorConfig(repeats=repeats),
    )
    return Curriculum(config, AVAILABLE)


def test_clean_executions_come_first() -> None:
    plan = curriculum()
    assert plan.size("experiment1") == 4
    assert [plan.next_case("a") for _ in range(5)] == [
        case(0, 0),
        case(7, 0),
        case(0, 1),
        case(7, 1),
        None,
    ]


def test_all_cases_are_planned_unless_some_are_named() -> None:
    assert curriculum(cases=None, repeats=4).size("experiment1") == 180


def test_cases_of_pretraining_come_before_all_others(make_episode: MakeEpisode) -> None:
    first = PretrainingConfig(task="reaching", cases=(0, 14), repeats=2)
    config = Config(
        learner=LearnerConfig(cases=(0,), pretraining=first), tutor=TutorConfig(repeats=1)
    )
    plan = Curriculum(config, AVAILABLE)
    assert (plan.size("reaching"), plan.size("experiment1")) == (4, 1)
    assert [plan.next_case("a") for _ in range(6)] == [
        *(case(number, repeat, "reaching") for repeat in (0, 1) for number in (0, 14)),
        case(0, 0),
        None,
    ]
    # the same case of the other task has the same seed, and is another one
    plan.keep(make_episode(kind=Kind.TUTORING, task="reaching", seed=0))
    assert plan.wants(make_episode(kind=Kind.TUTORING, task="experiment1", seed=0))
    assert not plan.wants(make_episode(kind=Kind.TUTORING, task="reaching", seed=0))
    assert plan.missing == 4


@pytest.mark.parametrize("without", [{"epochs": 0}, {"task": None}])
def test_pretraining_without_its_own_sequences_plans_no_cases(without: dict[str, Any]) -> None:
    config = Config(learner=LearnerConfig(pretraining=PretrainingConfig(**without)))
    assert Curriculum(config, AVAILABLE).size("experiment1") == 180


def test_demonstrated_cases_are_not_assigned_again(make_episode: MakeEpisode) -> None:
    plan = curriculum()
    shown = make_episode(kind=Kind.TUTORING, seed=case(7, 1).seed)
    assert plan.wants(shown)
    plan.keep(shown)
    plan.keep(shown)
    assert not plan.wants(shown)
    assert plan.missing == 3
    assert case(7, 1) not in [plan.next_case("a") for _ in range(4)]


def test_the_case_of_a_vanished_actor_is_assigned_again() -> None:
    plan = curriculum()
    assert plan.next_case("mortal") == case(0, 0)
    assert plan.next_case("other") == case(7, 0)
    plan.release("mortal")
    assert plan.next_case("other") == case(0, 0)


def test_only_tutored_cases_of_the_task_are_accepted(make_episode: MakeEpisode) -> None:
    plan = curriculum()
    assert not plan.wants(make_episode(kind=Kind.TRIAL, seed=0))
    assert not plan.wants(make_episode(kind=Kind.TUTORING, seed=0, task="experiment9"))
    assert not plan.wants(make_episode(kind=Kind.TUTORING, seed=1000))
    assert plan.wants(make_episode(kind=Kind.TUTORING, seed=0))


def test_an_episode_of_an_unplanned_case_is_refused(make_episode: MakeEpisode) -> None:
    plan = curriculum()
    assert plan.refusal(make_episode(kind=Kind.TUTORING, seed=7001)) == ""
    plan.keep(make_episode(kind=Kind.TUTORING, seed=7001))
    assert plan.refusal(make_episode(kind=Kind.TUTORING, seed=7001)) == "", "a second one is none"
    assert "with the seed 7002 is asked" in plan.refusal(
        make_episode(kind=Kind.TUTORING, seed=7002)
    )


def test_a_case_whose_simulation_fails_repeatedly_is_given_up(
    failure: Callable[..., EpisodeFailed],
) -> None:
    plan = curriculum(cases=(0,), repeats=2)
    for attempt in range(TRIES):
        assert plan.next_case("a") == case(0, 0)
        report = failure(f"report{attempt}", actor="a", seed=0)
        for number in range(TRIES):  # of an actor that was not asked
            assert not plan.fail(failure(f"{attempt}-{number}", actor="stranger", seed=0))
        given_up = plan.fail(report)
        assert given_up == (attempt == TRIES - 1)
        if not given_up:
            assert not plan.fail(report), "a report that is sent again counts once"
    assert plan.next_case("a") == case(0, 1)
    assert (plan.missing, plan.size("experiment1")) == (1, 1)
    assert not plan.fail(failure("late", seed=0))
    assert not plan.fail(failure("of-no-case", seed=5))


def test_a_case_that_kills_its_actors_is_given_up(failure: Callable[..., EpisodeFailed]) -> None:
    plan = curriculum(cases=(0,), repeats=1)
    for attempt in range(TRIES):
        assert plan.next_case("mortal") == case(0, 0)
        plan.release("mortal")
        assert plan.next_case("other") == case(0, 0), "somebody else plays it at once"
        report = failure(f"{attempt}", actor="mortal", seed=0, died=True)
        assert not plan.fail(failure(f"{attempt}-of-another-actor", actor="stranger", seed=0))
        assert plan.fail(report) == (attempt == TRIES - 1)
        assert plan.next_case("third") is None, "the other one still plays it, or it is given up"
        plan.release("other")
    assert (plan.missing, plan.size("experiment1")) == (0, 0)


def test_an_unknown_case_is_named() -> None:
    with pytest.raises(UserError, match=r"no case 45; the task experiment1 has .* 0 to 44"):
        curriculum(cases=(3, 45))
    first = PretrainingConfig(task="reaching", cases=(15,))
    with pytest.raises(UserError, match=r"learner.pretraining.cases: .* 15; the task reaching"):
        Curriculum(Config(learner=LearnerConfig(pretraining=first)), AVAILABLE)
