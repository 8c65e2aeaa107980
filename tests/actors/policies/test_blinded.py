"""A blinded policy sees changed pictures, whichever policy it is."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from actors.policies.blinded import BlindedPolicy
from actors.policies.by_name import make_policy
from actors.tasks.registry import make_task
from learner.network_policy import NetworkPolicy
from learner.pretrained import checkpoint_path
from proto.config import TaskConfig
from proto.episode import Image
from proto.errors import UserError
from proto.variables import Situation

PICTURES = np.random.default_rng(1).integers(0, 256, (6, 48, 64), dtype=np.uint8)


def dark_at_first(step: int, image: Image) -> Image:
    return np.zeros_like(image) if step < 3 else image


@dataclass
class Watching:
    """A policy that keeps what it saw."""

    name: str = "watching"
    version: int = 7
    looks: bool = True
    target: NDArray[np.float64] | None = None
    outputs: NDArray[np.float32] | None = None
    seen: list[Image] = field(default_factory=list)

    def begin(self, situation: Situation, seed: int) -> None:
        assert (situation, seed) == ({}, 5)

    def step(self, image: Image) -> NDArray[np.float64]:
        self.seen.append(image)
        self.target = np.full(11, float(len(self.seen)))
        return self.target


def test_it_acts_on_the_changed_pictures_of_every_episode() -> None:
    watching = Watching()
    blinded = BlindedPolicy("dark", watching, dark_at_first)
    assert (blinded.name, blinded.version, blinded.looks) == ("dark-watching", 7, True)
    for _ in range(2):
        blinded.begin({}, 5)
        actions = [blinded.step(picture) for picture in PICTURES]
        assert blinded.target is actions[-1]
    seen = np.stack(watching.seen).reshape(2, *PICTURES.shape)
    assert (seen[:, :3] == 0).all()
    assert (seen[:, 3:] == PICTURES[3:]).all()


def test_its_states_are_those_of_the_network_that_sees_the_changed_pictures() -> None:
    network = NetworkPolicy.from_file(checkpoint_path("pretrained:experiment1"))
    changed = np.stack([dark_at_first(step, picture) for step, picture in enumerate(PICTURES)])
    states = BlindedPolicy("dark", network, dark_at_first).states(PICTURES)
    wanted = network.states(changed)
    assert states.keys() == wanted.keys()
    assert all(np.array_equal(states[name], wanted[name]) for name in wanted)


def test_a_policy_without_states_is_named() -> None:
    with pytest.raises(UserError, match="policy 'dark-watching' has no states"):
        BlindedPolicy("dark", Watching(), dark_at_first).states(PICTURES)


def test_a_task_names_its_blinded_policies() -> None:
    task = make_task(TaskConfig(name="experiment2"))
    assert make_policy("blank-screen:tutor", task).name == "blank-screen-tutor"
    with pytest.raises(UserError, match="trained for the task 'experiment1'"):
        make_policy("blank-screen:pretrained:experiment1", task)
    with pytest.raises(UserError, match="blank-screen:POLICY"):
        make_policy("blank-screen", task)
    with pytest.raises(UserError, match="no such policy or checkpoint file"):
        make_policy("blank-screen:tutor", make_task(TaskConfig(name="experiment1")))
