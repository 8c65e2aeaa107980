"""Every epoch belongs to exactly one round."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from learner.training.schedule import RoundSchedule

SCHEDULES = st.builds(RoundSchedule, st.integers(1, 50), st.integers(0, 6), st.integers(1, 50))


def test_initial_training_and_two_rounds() -> None:
    schedule = RoundSchedule(initial_epochs=5, rounds=2, epochs_per_round=3)
    assert schedule.total == 11
    assert [schedule.round_at(epoch) for epoch in range(11)] == [0] * 5 + [1] * 3 + [2] * 3
    assert [schedule.start_of(number) for number in (0, 1, 2)] == [0, 5, 8]


@given(SCHEDULES)
def test_the_rounds_follow_each_other_without_a_gap(schedule: RoundSchedule) -> None:
    start = 0
    for number in range(schedule.rounds + 1):
        assert schedule.start_of(number) == start
        end = start + schedule.epochs_of(number)
        assert schedule.end_of(number) == end
        assert {schedule.round_at(epoch) for epoch in range(start, end)} == {number}
        start = end
    assert start == schedule.total
    assert schedule.round_at(schedule.total + 7) == schedule.rounds, "more epochs than planned"
