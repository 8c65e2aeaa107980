from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from learner.network.vmdnn import VMDNN
from learner.training.asked import Asked, soft_label
from learner.training.pretraining import Pretraining, window_mask
from proto.config import Config
from proto.episode import Episode
from proto.errors import UserError
from proto.variables import Question

QUESTIONS = (Question("object_y_m", 3), Question("object_yaw_deg", 5))


def test_classes_are_spread_over_the_situations(
    bar_episodes: Callable[..., Sequence[Episode]],
) -> None:
    episodes = bar_episodes(places=(0.1, 0.0, 1.0), slopes=(-1, 1))
    place, yaw = (Asked.of(question, episodes) for question in QUESTIONS)
    assert place.classes == pytest.approx((0.2, 0.25, 0.3))
    assert yaw.classes == pytest.approx((-45, -22.5, 0, 22.5, 45))


def test_the_classes_of_a_discrete_variable_are_its_choices(
    bar_episodes: Callable[..., Sequence[Episode]],
) -> None:
    episodes = [
        replace(episode, situation={**episode.situation, "kind": kind})
        for episode, kind in zip(bar_episodes(), ("b", "a", "a", "b"), strict=True)
    ]
    kind = Asked.of(Question("kind"), episodes)
    assert kind.classes == ("a", "b")
    assert soft_label("b", kind.classes).tolist() == [0, 1]
    with pytest.raises(UserError, match="knows the choices a, b, not 'c'"):
        soft_label("c", kind.classes)
    for wrong in (Question("kind", 2), Question("object_y_m")):
        with pytest.raises(UserError, match=f"question about {wrong.variable} does not fit"):
            Asked.of(wrong, episodes)


@given(st.floats(-100, 100), st.integers(2, 8))
def test_a_label_between_two_classes_is_divided_in_proportion(value: float, count: int) -> None:
    centres = np.linspace(-45, 45, count)
    label = soft_label(value, centres.tolist())
    assert label.sum() == pytest.approx(1, abs=1e-5)
    assert (label >= 0).all()
    assert (label > 0).sum() <= 2
    assert label @ centres == pytest.approx(np.clip(value, -45, 45), abs=1e-3)


def pretraining_of(
    config: Config, episodes: Sequence[Episode], **changes: float
) -> tuple[VMDNN, Pretraining]:
    """Pre-training without augmentation, but for `changes` of its config."""
    unchanged = {"image_shift": 0, "image_gain": 0.0, "image_noise": 0.0}
    pretraining = config.learner.pretraining.model_copy(update=unchanged | changes)
    generator = torch.Generator().manual_seed(1)
    network = VMDNN(config.network)
    network.initialize(generator, initial_range=0.1, pfc_input_range=0.2)
    asked = [Asked.of(Question(name, 2), episodes) for name in ("object_y_m", "object_yaw_deg")]
    objective = Pretraining(network, asked, pretraining, generator)
    for episode in episodes:
        objective.add(episode)
    return network, objective


def test_only_the_window_of_each_sequence_has_labels() -> None:
    """The answer may come from the memory of earlier pictures, but is read only in the window."""
    mask = window_mask([10, 20], (0.75, 1.0))
    assert mask[0].nonzero().ravel().tolist() == [7, 8, 9]
    assert mask[1].nonzero().ravel().tolist() == [15, 16, 17, 18, 19]
    assert window_mask([10], (0.2, 0.5))[0].nonzero().ravel().tolist() == [2, 3, 4]


def test_vision_learns_to_distinguish_situations(
    small_config: Callable[..., Config],
    bar_episodes: Callable[..., Sequence[Episode]],
) -> None:
    network, objective = pretraining_of(small_config(), bar_episodes(steps=20))
    adam = torch.optim.Adam(objective.parameters, 5e-3)
    everyone = torch.arange(4)
    at_first = objective.loss(everyone).item()
    feedback = network.pfc.feedback
    assert feedback is not None
    motor_before = [p.clone() for p in (feedback, network.mtrnn_slow.input)]
    for _ in range(60):
        adam.zero_grad()
        objective.loss(everyone).backward()
        adam.step()
    assert objective.loss(everyone).item() < 0.2 * at_first
    # the motor pathway has not been touched
    for before, after in zip(motor_before, (feedback, network.mtrnn_slow.input), strict=True):
        assert torch.equal(before, after)
