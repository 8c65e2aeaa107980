"""Every epoch lies in one lap."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from learner.training.schedule import Laps

LAPS = st.builds(Laps, st.integers(1, 50), st.integers(0, 6), st.integers(1, 50))


def test_a_first_lap_and_two_rounds() -> None:
    laps = Laps(first=5, rounds=2, each=3)
    assert laps.total == 11
    assert [laps.round_at(epoch) for epoch in range(11)] == [0] * 5 + [1] * 3 + [2] * 3
    assert [laps.start_of(number) for number in (0, 1, 2)] == [0, 5, 8]


@given(LAPS)
def test_the_laps_follow_each_other_without_a_gap(laps: Laps) -> None:
    begun = 0
    for number in range(laps.rounds + 1):
        assert laps.start_of(number) == begun
        begun += laps.length_of(number)
        assert laps.end_of(number) == begun
        inside = {laps.round_at(epoch) for epoch in range(laps.start_of(number), begun)}
        assert inside == {number}
    assert begun == laps.total
    assert laps.round_at(laps.total + 7) == laps.rounds, "more epochs than there should be"
