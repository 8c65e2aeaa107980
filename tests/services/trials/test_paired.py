"""Two lists of trials are compared situation by situation."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from outcomes import IMPRECISE, NOT_LIFTED, PRECISE, TOUCHED
from processes import run_vmdnn
from scipy.stats import binom

from proto.episode import Outcome
from proto.errors import UserError
from proto.suites import Conditions
from services.trials.paired import PairedCounts, pair_trials
from services.trials.trial_log import CountedTrial


def trial(
    seed: int,
    outcome: Outcome = PRECISE,
    *,
    version: int = 1,
    y: float = 0.25,
    conditions: Conditions | None = None,
) -> CountedTrial:
    return CountedTrial(
        run_id="run",
        policy_version=version,
        seed=seed,
        episode=f"episode-{seed}-{version}",
        actor="actor",
        situation={"object_y_m": y},
        outcome=outcome,
        format=2 if conditions is None else 3,
        conditions=conditions,
    )


def trials(outcomes: Sequence[Outcome]) -> list[CountedTrial]:
    return [trial(seed, outcome) for seed, outcome in enumerate(outcomes)]


def test_pairs_are_counted_in_each_reading() -> None:
    first = trials([PRECISE, PRECISE, TOUCHED, NOT_LIFTED])
    second = trials([PRECISE, IMPRECISE, PRECISE, NOT_LIFTED])
    paired = pair_trials(first, second)
    assert paired.counts("lenient") == PairedCounts(3, 0, 0, 1)
    assert paired.counts("strict") == PairedCounts(2, 0, 1, 1)
    assert paired.counts("precise") == PairedCounts(1, 1, 1, 1)
    assert (paired.only_in_first, paired.only_in_second) == (0, 0)


@given(*[st.integers(0, 40)] * 4)
def test_the_test_is_that_of_mcnemar(both: int, first: int, second: int, neither: int) -> None:
    counts = PairedCounts(both, first, second, neither)
    assert counts.first.successes - counts.second.successes == first - second
    # the exact test in its own words: twice the smaller tail of a fair coin
    tail = binom.cdf(min(first, second), first + second, 0.5)
    assert counts.p_value == pytest.approx(min(1.0, 2 * tail))


def test_trials_without_a_partner_are_told() -> None:
    paired = pair_trials([trial(1), trial(2), trial(3)], [trial(2), trial(5)])
    assert len(paired.pairs) == 1
    assert (paired.only_in_first, paired.only_in_second) == (2, 1)


def test_the_newest_policy_version_is_compared() -> None:
    first = [trial(1, NOT_LIFTED, version=1), trial(1, PRECISE, version=2)]
    assert pair_trials(first, [trial(1)]).counts("precise") == PairedCounts(1, 0, 0, 0)


def test_another_situation_under_a_seed_is_refused() -> None:
    with pytest.raises(UserError, match="1 of 2 seeds stand for other situations"):
        pair_trials([trial(1), trial(2)], [trial(1), trial(2, y=0.26)])


def test_other_disturbances_are_refused() -> None:
    pushed = Conditions("pushed", disturbance="pushed", strength=20.0)
    with pytest.raises(UserError, match="disturbances"):
        pair_trials([trial(1)], [trial(1, conditions=pushed)])


def test_nothing_in_common_is_refused() -> None:
    with pytest.raises(UserError, match="no trial in common"):
        pair_trials([trial(1)], [trial(2)])


def test_the_command_compares_two_files(tmp_path: Path) -> None:
    files = {"a.jsonl": [PRECISE, TOUCHED], "b.jsonl": [PRECISE, PRECISE]}
    for name, outcomes in files.items():
        (tmp_path / name).write_bytes(b"".join(each.line() for each in trials(outcomes)))
    words = [str(tmp_path / name) for name in files]
    ended = run_vmdnn("compare-trials", *words, "--json")
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout)["strict"]["only_second"] == 1
    shown = run_vmdnn("compare-trials", *words)
    assert "100.0 (34.2 to 100.0)" in shown.stdout
    missing = run_vmdnn("compare-trials", words[0], str(tmp_path / "missing.jsonl"))
    assert missing.returncode == 2
    assert "missing.jsonl cannot be read" in missing.stderr
