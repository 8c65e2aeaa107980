"""Suites: what every policy version is tried on, each with situations and conditions of its own.

The seeds of a suite decide everything about its trials: the situation, which of its disturbances
acts and how strongly. Test seeds are tried and counted. Practice seeds may be practised and
corrected in. No seed belongs to two suites, and no seed is both.
"""

from __future__ import annotations

import random
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final

from proto.codec import Many, Number, Size, Text
from proto.disturbances import DISTURBANCES, Ability

SuiteName = Annotated[str, Text(64, r"[A-Za-z0-9][A-Za-z0-9._-]*")]

UNLEARNED: Final = "unlearned"
"""The suite of the paper: situations inside the tutored ranges, without disturbances."""

MOST_SUITES: Final = 64
MOST_STRETCH: Final = 3.0
TEST_SEEDS: Final = range(2**28, 2**29)
"""Where suites have their test seeds, unless the configuration says otherwise."""
PRACTICE_SEEDS: Final = range(2**31, 2**32)
"""Practice seeds of all suites except `unlearned`, which has `proto.seeds.PRACTICE`."""
_BLOCKS: Final = 2**14
"""Each suite has a block of test seeds and one of practice seeds, which its name selects."""
TESTS_OF_SUITE: Final = len(TEST_SEEDS) // _BLOCKS
PRACTICE_OF_SUITE: Final = len(PRACTICE_SEEDS) // _BLOCKS


@dataclass(frozen=True)
class Conditions:
    """Under which conditions of a suite an episode is played.

    Attributes:
        suite: name of the suite.
        stretch: factor by which the ranges of the situation's variables are stretched.
        disturbance: name of the disturbance, empty for none.
        strength: its strength in its unit, 0 for none.
    """

    suite: SuiteName
    stretch: Annotated[float, Number(1.0, MOST_STRETCH)] = 1.0
    disturbance: Annotated[str, Text(64)] = ""
    strength: Annotated[float, Number(0.0, 1e6)] = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError if there is no such disturbance, or if it cannot be so strong."""
        if not self.disturbance:
            return
        if self.disturbance not in DISTURBANCES:
            raise ValueError(f"there is no disturbance {self.disturbance!a:.66}")
        if problem := DISTURBANCES[self.disturbance].problem(self.strength):
            raise ValueError(f"{self.disturbance}: {problem}")

    @property
    def ability(self) -> Ability | None:
        """What the simulator must be able to do; None if every simulator can play this."""
        return DISTURBANCES[self.disturbance].ability if self.disturbance else None


@dataclass(frozen=True)
class Player:
    """What an actor can play, as it says in its requests.

    Attributes:
        backend: name of its simulator.
        abilities: what its simulator can do, see `Ability`.
    """

    backend: str
    abilities: Annotated[tuple[str, ...], Many(Text(64), Size("abilities", 0, 64))] = ()

    def can_play(self, backend: str, conditions: Conditions | None) -> bool:
        """Whether it can play an episode in this simulator under these conditions."""
        ability = None if conditions is None else conditions.ability
        return self.backend == backend and (ability is None or ability in self.abilities)


@dataclass(frozen=True)
class Suite:
    """Situations and conditions on which policies are tried.

    Attributes:
        name: its name.
        backend: name of the simulator in which it is played.
        test_seeds: seeds of its trials.
        practice_seeds: seeds of its situations for practice and corrections.
        stretch: factor by which the ranges of the situation's variables are stretched about their
            middles. With more than 1 each situation lies outside the ranges.
        disturbances: weakest and strongest strength by name; one of them acts in each episode.
    """

    name: str
    backend: str
    test_seeds: range
    practice_seeds: range
    stretch: float = 1.0
    disturbances: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def conditions(self, seed: int) -> Conditions | None:
        """The conditions of the episode with a seed; None in the plain suite `unlearned`."""
        name, strength = "", 0.0
        if self.disturbances:
            chance = random.Random(f"disturbance {seed}")
            name = chance.choice(sorted(self.disturbances))
            strength = chance.uniform(*self.disturbances[name])
        found = Conditions(self.name, self.stretch, name, strength)
        return None if found == Conditions(UNLEARNED) else found


def suite_of(conditions: Conditions | None) -> str:
    """Name of the suite of an episode; an episode without conditions is of `unlearned`."""
    return UNLEARNED if conditions is None else conditions.suite


def first_test_seed(name: str) -> int:
    """First test seed of a suite, the same in every run."""
    return TEST_SEEDS.start + _block(name) * TESTS_OF_SUITE


def first_practice_seed(name: str) -> int:
    """First practice seed of a suite, the same in every run."""
    return PRACTICE_SEEDS.start + _block(name) * PRACTICE_OF_SUITE


def _block(name: str) -> int:
    return zlib.crc32(name.encode()) % _BLOCKS


def _disturbed(*names: str) -> dict[str, Any]:
    return {"disturbances": {name: DISTURBANCES[name].usual for name in names}}


BUILT_IN: Final[Mapping[str, Mapping[str, Any]]] = {
    UNLEARNED: {},
    "beyond": {"stretch": 1.2},
    "disturbed": _disturbed(*DISTURBANCES),
    **{name: _disturbed(name) for name in DISTURBANCES},
}
"""Suites that need no definition: what they set, by name."""
