"""Rates and intervals are correct; every outcome is counted once in each reading."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from outcomes import IMPRECISE, NOT_LIFTED, PRECISE, TOUCHED
from scipy.stats import binomtest

from services.trials.success import READINGS, Tally, wilson95


@pytest.mark.parametrize(("successes", "low", "high"), [(44, 0.725, 0.920), (32, 0.480, 0.735)])
def test_the_interval_of_the_papers_results(successes: int, low: float, high: float) -> None:
    assert wilson95(successes, 52) == pytest.approx((low, high), abs=5e-4)


@given(st.integers(1, 2000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_the_interval_agrees_with_scipy(counts: tuple[int, int]) -> None:
    expected = binomtest(*counts).proportion_ci(method="wilson")
    assert wilson95(*counts) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_a_tally_counts_each_reading_and_reason() -> None:
    tally = Tally.of([PRECISE] * 5 + [IMPRECISE] * 2 + [TOUCHED] + [NOT_LIFTED] * 2)
    result = json.loads(json.dumps(tally.as_json()))
    assert result["trials"] == 10
    assert [result[reading]["successes"] for reading in READINGS] == [8, 7, 5]
    assert [result[reading]["rate"] for reading in READINGS] == [0.8, 0.7, 0.5]
    assert result["strict"]["wilson95"] == pytest.approx(wilson95(7, 10))
    assert result["reasons"] == {"imprecise": 2, "touched_obstacle": 1, "not_lifted": 2}


def test_an_empty_tally_has_the_widest_interval() -> None:
    result = Tally().as_json()
    assert result["strict"] == {"successes": 0, "rate": 0.0, "wilson95": [0.0, 1.0]}
    assert result["reasons"] == {}
