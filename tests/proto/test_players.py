"""It is known what the present actors can play, and what none of them can."""

from __future__ import annotations

from proto.players import PATIENCE_S, Players
from proto.suites import Player


class Clock:
    time_s = 0.0

    def __call__(self) -> float:
        return self.time_s


def has_mujoco(player: Player) -> bool:
    return player.backend == "mujoco"


def test_what_no_actor_can_play_is_lacking_after_some_patience() -> None:
    clock = Clock()
    players = Players(clock)
    clock.time_s += 10 * PATIENCE_S
    assert not players.lack(has_mujoco), "there is no actor that could tell"
    players.note("a", Player("sapien"))
    assert not players.lack(has_mujoco), "another may be about to ask"
    clock.time_s += PATIENCE_S
    assert players.lack(has_mujoco)
    players.note("a", Player("sapien"))
    assert players.lack(has_mujoco), "nothing has changed"


def test_an_actor_that_has_not_asked_yet_may_be_able() -> None:
    clock = Clock()
    players = Players(clock)
    players.note("a", Player("sapien"))
    players.presence("b", True)
    clock.time_s += PATIENCE_S
    assert not players.lack(has_mujoco)
    players.note("b", Player("mujoco"))
    clock.time_s += PATIENCE_S
    assert not players.lack(has_mujoco)
    players.presence("b", False)
    assert not players.lack(has_mujoco), "it may have crashed, and come back"
    clock.time_s += PATIENCE_S
    assert players.lack(has_mujoco)
    players.presence("b", False)
    assert players.lack(has_mujoco)
