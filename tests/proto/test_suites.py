"""Suites: what the configuration makes of them, their seeds, and their conditions."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from proto.codec import MessageError, decode, encode
from proto.config import Config, load_config
from proto.disturbances import DISTURBANCES, Ability
from proto.errors import UserError
from proto.messages import Trial
from proto.seeds import PRACTICE, TRIALS_BELOW
from proto.suites import BUILT_IN, UNLEARNED, Conditions, Player, Suite


def suites(text: str, *more: str) -> Config:
    return load_config(None, [f"evaluator.suites={text}", *more])


def test_without_the_key_there_is_one_plain_suite() -> None:
    config = load_config(None, ["evaluator.trials_per_policy=7", "evaluator.seed=70"])
    (suite,) = config.suites
    assert suite == Suite(UNLEARNED, "sapien", range(70, 77), PRACTICE)
    assert suite.conditions(70) is None
    assert config.practised_suites() == (suite,)


def test_a_built_in_suite_needs_its_name_only_and_can_be_changed() -> None:
    config = suites(
        "[unlearned, beyond, {name: disturbed, trials: 9, seed: 5},"
        " {name: pushed, disturbances: {pushed: 20}}, {name: mine, disturbances: {noisy: }},"
        " {name: elsewhere, backend: other}]",
        "evaluator.trials_per_policy=7",
    )
    unlearned, beyond, disturbed, pushed, mine, elsewhere = config.suites
    assert (unlearned.stretch, dict(unlearned.disturbances)) == (1.0, {})
    assert (beyond.stretch, len(beyond.test_seeds)) == (1.2, 7)
    assert disturbed.test_seeds == range(5, 14)
    assert disturbed.disturbances.keys() == DISTURBANCES.keys()
    assert pushed.disturbances == {"pushed": (20.0, 20.0)}
    assert pushed.conditions(3) == Conditions("pushed", 1.0, "pushed", 20.0)
    assert mine.disturbances == {"noisy": DISTURBANCES["noisy"].usual}
    assert (elsewhere.backend, beyond.backend) == ("other", "sapien")
    assert elsewhere.conditions(elsewhere.test_seeds[0]) == Conditions("elsewhere")
    assert config.suite("turned").disturbances.keys() == {"turned"}, "without being configured"
    with pytest.raises(UserError, match="there is no suite 'tuned'; there are: unlearned, "):
        config.suite("tuned")


def test_suites_survive_the_saved_configuration(tmp_path: Path) -> None:
    config = suites("[unlearned, {name: disturbed, disturbances: {pushed: [10, 12.5]}}]")
    config.save(tmp_path / "config.yaml")
    again = load_config(tmp_path / "config.yaml")
    assert again == config
    assert again.suites == config.suites


def test_no_two_built_in_suites_share_seeds() -> None:
    config = load_config(None)
    found = [config.suite(name) for name in BUILT_IN]
    for one, other in combinations(found, 2):
        for kind in ("test_seeds", "practice_seeds"):
            first, second = getattr(one, kind), getattr(other, kind)
            assert first.start >= second.stop or second.start >= first.stop, (one.name, other.name)
    assert all(suite.test_seeds.stop <= TRIALS_BELOW for suite in found)
    assert all(suite.practice_seeds.start >= PRACTICE.start for suite in found)
    load_config(None, [f"evaluator.suites=[{', '.join(BUILT_IN)}]"])


@given(seed=st.integers(0, 2**32), name=st.sampled_from(sorted(BUILT_IN)))
def test_a_seed_decides_about_the_conditions(seed: int, name: str) -> None:
    suite = load_config(None).suite(name)
    found = suite.conditions(seed)
    assert found == suite.conditions(seed)
    if not suite.disturbances:
        assert found is None or not found.disturbance
        return
    assert found is not None
    weakest, strongest = suite.disturbances[found.disturbance]
    assert weakest <= found.strength <= strongest
    assert found.ability == DISTURBANCES[found.disturbance].ability


def test_the_mixture_has_all_its_disturbances() -> None:
    suite = load_config(None).suite("disturbed")
    drawn = [suite.conditions(seed) for seed in range(400)]
    assert {each.disturbance for each in drawn if each} == set(DISTURBANCES)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[{name: a, disturbances: {pusht: 3}}]", "there is no disturbance 'pusht'"),
        ("[{name: a, disturbances: {pushed: 300}}]", "300 lies outside 1 .. 50 mm"),
        ("[{name: a, disturbances: {pushed: [20, 10]}}]", "20 .. 10 is upside down"),
        ("[{name: a, disturbances: {pushed: far}}]", "expected a strength or a range"),
        ("[{name: a, disturbances: pushed}]", "expected disturbances by name"),
        ("[{name: a, stretch: 0.5}]", "stretch"),
        ("[{name: a, strech: 1.5}]", "evaluator.suites.0.strech: there is no such key"),
        ("[{stretch: 1.5}]", "evaluator.suites.0.name"),
        ("[beyond, beyond]", "there are two suites 'beyond'"),
        ("[unlearned, {name: b, seed: 1030}]", "test seeds of two suites overlap: unlearned 1000"),
        (
            "[{name: a, practice_seed: 2147483648}, {name: b, practice_seed: 2147483649}]",
            "practice seeds of two suites overlap",
        ),
        ("[{name: a, practice_seed: 1000}]", "practice_seed"),
        ("[{name: a, seed: 536870911}]", "must be below 536870912"),
        ("[]", "expected 1 to 64 suites"),
    ],
)
def test_wrong_suites_are_refused(text: str, said: str) -> None:
    with pytest.raises(UserError) as refusal:
        suites(text)
    assert said in str(refusal.value)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("learner.corrections={suites: [beyond]}", "there is no 'beyond' in evaluator.suites"),
        (
            "learner.corrections={suites: [disturbed], choose: random}",
            "needs learner.corrections.choose: failures",
        ),
        ("done.trials=60", "the 52 trials of the largest suite"),
    ],
)
def test_settings_that_do_not_fit_the_suites_are_refused(setting: str, said: str) -> None:
    with pytest.raises(UserError) as refusal:
        suites("[unlearned, disturbed]", setting)
    assert said in str(refusal.value)


def test_an_actor_is_asked_for_what_it_can_play() -> None:
    blind, able = Player("a"), Player("a", (Ability.SHOVES,))
    pushed = Conditions("pushed", 1.0, "pushed", 20.0)
    assert able.can_play("a", pushed)
    assert not blind.can_play("a", pushed)
    assert not able.can_play("b", pushed)
    assert blind.can_play("a", None)
    assert blind.can_play("a", Conditions("noisy", 1.0, "noisy", 9.0))


def test_impossible_conditions_are_refused_on_the_bus() -> None:
    wire = encode(Trial(1, 5, Conditions("pushed", 1.0, "pushed", 20.0)))
    assert decode(wire, Trial) == Trial(1, 5, Conditions("pushed", 1.0, "pushed", 20.0))
    for before, after in ((b"pushed\xa8", b"pushes\xa8"), (b"\xcb@4", b"\xcbA4")):
        assert before in wire.payload
        wrong = wire.payload.replace(before, after)
        with pytest.raises(MessageError, match="conditions"):
            decode(type(wire)(wire.encoding, wrong), Trial)


def test_the_document_lists_every_disturbance_with_its_strengths() -> None:
    text = (Path(__file__).parents[2] / "docs" / "generalization.md").read_text()
    section = text.partition("\n## Disturbances\n")[2].partition("\n## ")[0]
    rows = {
        cells[1].strip("` "): [cell.strip() for cell in cells[2:-1]]
        for cells in (line.split("|") for line in section.splitlines() if line.startswith("| `"))
    }
    for name, disturbance in DISTURBANCES.items():
        _, usual, allowed, needs = rows[name]
        low, high = disturbance.usual
        ends = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        assert usual == f"{ends} {disturbance.unit}"
        assert allowed == f"{disturbance.least:g} to {disturbance.most:g} {disturbance.unit}"
        assert needs == (f"`{disturbance.ability}`" if disturbance.ability else "")
