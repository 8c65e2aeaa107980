"""Rates have the same text in all tables."""

from __future__ import annotations

import pytest

from services.terminal.rates import difference_text, interval_text, percent_text, rate_text
from services.trials.success import Rate


def test_a_rate_is_shown_with_its_wilson_interval() -> None:
    assert rate_text(Rate(8, 12)) == "66.7 (39.1 to 86.2)"
    assert rate_text(Rate(8, 12), digits=0) == "67 (39 to 86)"
    assert rate_text(Rate(0, 0)) == "0.0 (0.0 to 100.0)", "nothing was tried"


def test_rate_and_interval_can_be_shown_alone() -> None:
    assert percent_text(0.125) == "12.5"
    assert interval_text((0.391, 0.862), digits=0) == "39 to 86"


@pytest.mark.parametrize(
    ("difference", "interval", "text"),
    [
        (0.08, (-0.015, 0.172), "+8.0 (-1.5 to +17.2)"),
        (-0.1, (-0.2, -0.05), "-10.0 (-20.0 to -5.0)"),
    ],
)
def test_differences_have_signs(
    difference: float, interval: tuple[float, float], text: str
) -> None:
    assert difference_text(difference, interval) == text
