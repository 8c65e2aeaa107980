"""Only trials that this run asked for count, also when the evaluator was restarted."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.trials.asked import AskedTrials, NotYetError


def asked(*, restarted: bool = True, **counted: list[int]) -> AskedTrials[int]:
    return AskedTrials(lambda run_id: counted.get(run_id, []), has_predecessor=restarted)


def test_a_trial_counts_for_the_actor_that_was_asked() -> None:
    trials = asked()
    trials.publish(("t", 1))
    trials.publish(("t", 2))
    trials.give(("t", 2), 70, "a")
    assert trials.trial_problem(("t", 2), 70, "a") == ""
    assert "not asked of b" in trials.trial_problem(("t", 2), 70, "b")
    assert "not asked of a" in trials.trial_problem(("t", 2), 71, "a")


def test_a_trial_that_a_predecessor_asked_for_counts() -> None:
    trials = asked(before=[1, 2])
    trials.publish(("t", 3))  # the first that this process hears of
    for policy in (("t", 1), ("t", 3), ("before", 2)):
        assert trials.policy_problem(policy) == ""
        assert trials.trial_problem(policy, 70, "anybody") == ""
    trials.publish(("t", 4))
    assert trials.policy_problem(("t", 4)) == ""
    assert "not asked of" in trials.trial_problem(("t", 4), 70, "anybody")
    assert trials.trial_problem(("t", 3), 70, "anybody") == ""


def test_the_first_evaluator_of_a_run_counts_no_trial_without_a_lease() -> None:
    trials = asked(restarted=False)
    trials.publish(("t", 1))
    assert trials.policy_problem(("t", 1)) == ""
    assert "not asked of a" in trials.trial_problem(("t", 1), 70, "a")
    trials.give(("t", 1), 70, "a")
    assert trials.trial_problem(("t", 1), 70, "a") == ""


def test_policies_of_other_trainings_are_none_of_this_run() -> None:
    trials = asked(before=[1, 2])
    trials.publish(("t", 3))
    assert "published" in trials.policy_problem(("stranger", 1))
    assert "published" in trials.policy_problem(("before", 3))
    assert "published" in trials.policy_problem(("t", 0))


def test_a_policy_that_was_not_heard_of_yet_is_neither_counted_nor_refused() -> None:
    trials = asked()
    with pytest.raises(NotYetError):
        trials.policy_problem(("t", 1))
    trials.publish(("t", 1))
    with pytest.raises(NotYetError):
        trials.policy_problem(("t", 2))


@given(
    st.lists(st.tuples(st.sampled_from("tuv"), st.integers(1, 9)), max_size=8),
    st.tuples(st.sampled_from("tuvx"), st.integers(-1, 12)),
)
def test_nothing_that_was_not_published_counts(
    published: list[tuple[str, int]], policy: tuple[str, int]
) -> None:
    trials = asked()
    for each in published:
        trials.publish(each)
    run_id, newest = trials.newest
    try:
        fine = trials.policy_problem(policy) == ""
    except NotYetError:
        fine = False
    assert fine == (policy[0] == run_id and 1 <= policy[1] <= newest)
