"""A round of corrections: its situations, the actors that get them, and its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from outcomes import IMPRECISE, PRECISE

from actors.tasks.registry import make_task
from learner.tutoring.corrections import Round
from learner.tutoring.failures import TRIES
from proto.config import Config, TaskConfig
from proto.disturbances import Ability
from proto.episode import Episode, Kind, Outcome
from proto.messages import Correction, EpisodeFailed, TutoringRequest, Verdict
from proto.seeds import CORRECTIONS, PRACTICE
from proto.suites import Player, Suite

MakeEpisode = Callable[..., Episode]
TASK = make_task(TaskConfig())
POLICY = ("training", 7)
P = PRACTICE.start
SAPIEN = Player("sapien")


def make_round(
    number: int = 1,
    cases: tuple[int, ...] | None = None,
    resumed: bool = False,
    **given: Any,
) -> Round:
    corrections = {"rounds": 3, "choose": "failures", "sequences": 2, "tries": 5, **given}
    config = Config.model_validate({"learner": {"cases": cases, "corrections": corrections}})
    return Round(config, number, POLICY, TASK, resumed=resumed)


def ask(round_: Round, actor: str = "actor", policy: tuple[str, int] = POLICY) -> Correction | None:
    return round_.next_correction(TutoringRequest(actor, *policy, "digest", SAPIEN))


def ask_all(round_: Round) -> list[Correction]:
    asked = []
    while (correction := ask(round_)) is not None:
        asked.append(correction)
    return asked


def verdict(seed: int, outcome: Outcome = IMPRECISE, **given: Any) -> Verdict:
    values = {"run_id": "training", "policy_version": 7, "task": "experiment1", **given}
    values.setdefault("backend", "sapien")
    return Verdict(seed=seed, situation=TASK.sample(seed), outcome=outcome, **values)


@pytest.fixture
def correction(make_episode: MakeEpisode) -> Callable[..., Episode]:
    def make(seed: int, **given: Any) -> Episode:
        values = {
            "kind": Kind.CORRECTION,
            "policy_version": 7,
            "training": "training",
            "task": "experiment1",
            **given,
        }
        return make_episode(5, seed=seed, **values)

    return make


def test_failures_of_practice_are_corrected(correction: Callable[..., Episode]) -> None:
    round_ = make_round()
    assert ask(round_) is None
    round_.judge(verdict(P + 1, PRECISE))
    round_.judge(verdict(P + 2))
    round_.judge(verdict(P + 2))  # a rollout that was sent twice
    assert ask_all(round_) == [Correction("experiment1", P + 2, TASK.sample(P + 2))]
    assert (round_.judged, round_.kept, round_.most) == (2, 0, 2)

    round_.keep(correction(P + 2))
    round_.judge(verdict(P + 2))
    assert ask(round_) is None
    assert not round_.complete, "there may be more failures"
    round_.judge(verdict(P + 3))
    round_.judge(verdict(P + 4))
    assert [asked.seed for asked in ask_all(round_)] == [P + 3], "two are enough"
    assert not round_.complete
    round_.keep(correction(P + 3))
    assert round_.complete
    assert round_.kept == 2


def test_the_search_for_failures_of_a_good_policy_ends(
    correction: Callable[..., Episode],
) -> None:
    round_ = make_round()
    round_.judge(verdict(P))
    for seed in range(1, 5):
        assert not round_.complete
        round_.judge(verdict(P + seed, PRECISE))
    assert not round_.complete, "the one failure is still to be corrected"
    round_.judge(verdict(P + 9))
    assert [asked.seed for asked in ask_all(round_)] == [P]
    assert not round_.is_played_by(Player("third"))
    round_.keep(correction(P))
    assert round_.complete
    assert round_.is_played_by(Player("third")), "it waits for nobody"


@pytest.mark.parametrize(
    "foreign", [{"policy_version": 6}, {"run_id": "before"}, {"task": "reaching"}]
)
def test_only_practice_of_the_newest_policy_counts(foreign: dict[str, Any]) -> None:
    round_ = make_round()
    round_.judge(verdict(P + 2, **foreign))
    assert ask(round_) is None
    assert round_.judged == 0


def test_only_actors_with_the_newest_policy_get_corrections() -> None:
    round_ = make_round(choose="random")
    assert ask(round_, policy=("training", 6)) is None
    assert ask(round_, policy=("before", 7)) is None
    assert ask(round_, policy=("", 0)) is None
    assert ask(round_) is not None


def test_random_situations_depend_on_the_round_only() -> None:
    first, again, second = (
        ask_all(make_round(number, choose="random", sequences=20)) for number in (1, 1, 2)
    )
    assert first == again
    seeds = {correction.seed for correction in (*first, *second)}
    assert len(seeds) == 40
    assert all(seed in CORRECTIONS for seed in seeds)
    assert all(dict(asked.situation) == dict(TASK.sample(asked.seed)) for asked in first)


def test_tutored_cases_are_corrected_in_their_order() -> None:
    def cases(number: int, **given: Any) -> list[int]:
        asked = ask_all(make_round(number, choose="tutored", **given))
        assert all(dict(one.situation) == dict(TASK.tutored()[one.seed]) for one in asked)
        return [one.seed for one in asked]

    assert cases(1, sequences=45) == cases(2, sequences=45) == list(range(45))
    assert cases(2, sequences=30) == [*range(30, 45), *range(15)]
    assert cases(1, sequences=60, cases=(3, 5, 8)) == [3, 5, 8]
    assert make_round(choose="tutored", sequences=60).most == 45


def test_the_situation_of_a_vanished_actor_is_assigned_to_another() -> None:
    round_ = make_round(choose="tutored")
    asked = ask(round_, "mortal")
    assert ask(round_, "other") != asked
    round_.release("mortal")
    assert ask(round_, "other") == asked


def test_only_corrections_of_this_round_are_accepted_and_each_once(
    correction: Callable[..., Episode],
) -> None:
    round_ = make_round(choose="tutored", sequences=1)
    ours = correction(0)
    for foreign in (
        {"kind": Kind.TUTORING},
        {"kind": Kind.PRACTICE},
        {"policy_version": 6},
        {"training": "an earlier one"},
        {"training": ""},
        {"task": "reaching"},
        {"seed": 1},
    ):
        other = replace(ours, **foreign)  # type: ignore[arg-type]
        assert not round_.wants(other)
        round_.keep(other)
    assert round_.kept == 0
    assert round_.wants(ours)
    round_.keep(ours)
    assert not round_.wants(ours)
    assert round_.complete


def test_a_correction_whose_simulation_fails_repeatedly_is_given_up(
    correction: Callable[..., Episode], failure: Callable[..., EpisodeFailed]
) -> None:
    round_ = make_round(choose="tutored", sequences=2)
    policy = {"kind": Kind.CORRECTION, "training": "training", "policy_version": 7}
    assert not round_.fail(failure("other-policy", **policy | {"policy_version": 6}))
    for attempt in range(TRIES):
        asked = ask(round_)
        assert asked is not None
        assert asked.seed == 0
        assert round_.fail(failure(f"{attempt}", **policy)) == (attempt == TRIES - 1)
    assert [asked.seed for asked in ask_all(round_)] == [1]
    assert not round_.complete
    round_.keep(correction(1))
    assert round_.complete
    assert (round_.kept, round_.most) == (1, 2)


def test_a_situation_that_was_given_up_is_not_chosen_again(
    failure: Callable[..., EpisodeFailed],
) -> None:
    round_ = make_round()
    round_.judge(verdict(P + 2))
    policy = {"kind": Kind.CORRECTION, "training": "training", "policy_version": 7, "seed": P + 2}
    for attempt in range(TRIES):
        assert ask(round_) is not None
        round_.fail(failure(f"{attempt}", **policy))
    round_.judge(verdict(P + 2))
    assert ask(round_) is None


def test_corrections_requested_before_a_restart_are_accepted(
    correction: Callable[..., Episode],
) -> None:
    assert not make_round().wants(correction(P + 77)), "no former process began this round"
    round_ = make_round(resumed=True)  # knows of no failure any more
    assert not round_.wants(correction(77)), "not a seed of practice"
    assert round_.wants(correction(P + 77))
    round_.keep(correction(P + 77))
    assert not round_.wants(correction(P + 77))
    round_.judge(verdict(P + 78))
    assert not round_.wants(correction(P + 79)), "two are enough"
    round_.keep(correction(P + 78))
    assert round_.complete


@pytest.mark.parametrize(
    ("seed", "given", "problem"),
    [
        (P + 2, {"situation": {}}, "its situation is not the one of the seed"),
        (P + 2, {"situation": dict(TASK.sample(P + 3))}, "its situation is not the one of"),
        (P + 2, {"situation": {**TASK.sample(P + 2), "object_y_m": 1e12}}, "its situation"),
        (70, {}, "its seed 70 is none of practice"),
    ],
)
def test_verdicts_that_cannot_be_true_are_ignored(
    seed: int, given: dict[str, Any], problem: str
) -> None:
    round_ = make_round()
    assert problem in round_.judge(replace(verdict(seed), **given))
    assert round_.judge(verdict(P + 4)) == ""
    assert round_.judged == 1
    assert [asked.seed for asked in ask_all(round_)] == [P + 4]


def test_the_failure_of_an_actor_that_was_not_asked_is_ignored(
    failure: Callable[..., EpisodeFailed],
) -> None:
    round_ = make_round(choose="tutored")
    assert ask(round_, "a") is not None
    policy = {"kind": Kind.CORRECTION, "training": "training", "policy_version": 7}
    for attempt in range(2 * TRIES):
        assert not round_.fail(failure(f"{attempt}", actor="stranger", **policy))
    assert ask(round_, "b") != ask(round_, "c"), "the first situation is still leased"


DISTURBED = {
    "evaluator": {"suites": ["unlearned", "disturbed", {"name": "elsewhere", "backend": "other"}]},
    "learner": {
        "corrections": {
            "rounds": 1,
            "sequences": 9,
            "tries": 20,
            "suites": ["disturbed", "elsewhere"],
        }
    },
}
ABLE = Player("sapien", tuple(Ability))


def of_suite(suite: Suite, seed: int, **given: Any) -> Verdict:
    values = {"backend": suite.backend, "conditions": suite.conditions(seed), **given}
    return verdict(seed, **values)


def test_failures_of_named_suites_are_corrected_under_their_conditions() -> None:
    config = Config.model_validate(DISTURBED)
    round_ = Round(config, 1, POLICY, TASK)
    disturbed, elsewhere = config.suite("disturbed"), config.suite("elsewhere")
    pushed = next(
        seed
        for seed in disturbed.practice_seeds
        if (drawn := disturbed.conditions(seed)) and drawn.disturbance == "pushed"
    )
    other = elsewhere.practice_seeds[7]
    round_.judge(of_suite(disturbed, pushed))
    round_.judge(of_suite(elsewhere, other))
    assert round_.judged == 2

    def asked_by(player: Player) -> Correction | None:
        return round_.next_correction(TutoringRequest("actor", *POLICY, "digest", player))

    assert asked_by(SAPIEN) is None, "its simulator cannot push an object"
    assert not round_.is_played_by(Player("third"))
    assert asked_by(ABLE) == Correction(
        "experiment1", pushed, TASK.sample(pushed), disturbed.conditions(pushed)
    )
    correction = asked_by(Player("other"))
    assert correction is not None
    assert (correction.seed, correction.conditions) == (other, elsewhere.conditions(other))


def test_no_trial_is_ever_corrected(correction: Callable[..., Episode]) -> None:
    config = Config.model_validate(DISTURBED)
    round_ = Round(config, 1, POLICY, TASK)
    disturbed = config.suite("disturbed")
    tested = [seed for suite in config.suites for seed in suite.test_seeds]
    for seed in tested:
        round_.judge(of_suite(disturbed, seed))
        round_.judge(verdict(seed))
        assert not round_.wants(correction(seed))
    practised = disturbed.practice_seeds[0]
    for wrong in (
        {"conditions": None},
        {"conditions": config.suite("beyond").conditions(practised)},
        {"backend": "other"},
    ):
        round_.judge(of_suite(disturbed, practised, **wrong))
    round_.judge(of_suite(disturbed, config.suite("elsewhere").practice_seeds[0]))
    assert round_.judged == 0
    assert round_.next_correction(TutoringRequest("actor", *POLICY, "digest", ABLE)) is None
