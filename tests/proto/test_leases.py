"""Work has one holder at a time, and is assigned again when its holder is gone."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from proto.leases import Leases


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_each_holder_gets_different_work() -> None:
    leases: Leases[int] = Leases(10.0, Clock())
    assert [leases.take(name, [1, 2]) for name in ("a", "b", "c")] == [1, 2, None]
    assert len(leases) == 2


def test_a_lease_ends_when_time_holder_or_work_ends() -> None:
    clock = Clock()
    leases: Leases[int] = Leases(10.0, clock)
    assert leases.take("a", [1]) == 1
    clock.now_s = 9.9
    assert leases.take("b", [1]) is None
    clock.now_s = 10.0
    assert leases.take("b", [1]) == 1
    leases.release("a")  # it lost it before
    assert leases.take("c", [1]) is None
    leases.release("b")
    assert leases.take("c", [1]) == 1
    leases.finish(1)
    assert len(leases) == 0


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("take"), st.sampled_from("abc")),
            st.tuples(st.just("release"), st.sampled_from("abc")),
            st.tuples(st.just("wait"), st.floats(0, 6)),
        )
    )
)
def test_no_work_has_two_holders(happenings: list[tuple[str, object]]) -> None:
    clock = Clock()
    leases: Leases[int] = Leases(10.0, clock)
    held: dict[int, tuple[object, float]] = {}
    for what, who in happenings:
        if what == "wait":
            clock.now_s += float(str(who))
        elif what == "release":
            leases.release(str(who))
            held = {item: lease for item, lease in held.items() if lease[0] != who}
        else:
            item = leases.take(str(who), range(3))
            held = {taken: lease for taken, lease in held.items() if lease[1] > clock.now_s}
            assert item not in held
            assert (item is None) == (len(held) == 3)
            if item is not None:
                held[item] = (who, clock.now_s + 10.0)
        held = {taken: lease for taken, lease in held.items() if lease[1] > clock.now_s}
        assert len(leases) == len(held)
