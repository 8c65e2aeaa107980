from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from learner.network.vision_input import vision_input
from learner.network_policy import NetworkPolicy
from learner.training.trainer import Trainer
from learner.training.vmdnn_recipe import VMDNNRecipe
from learner.tutoring.store import TutoringStore
from proto.body import ACTION_VALUES
from proto.config import Config
from proto.episode import Episode
from proto.errors import UserError
from proto.variables import Question

QUESTIONS = (Question("object_y_m", 3), Question("object_yaw_deg", 5))

MakeConfig = Callable[..., Config]


@pytest.fixture
def trainer(
    tmp_path: Path, small_config: MakeConfig, bar_episodes: Callable[..., Sequence[Episode]]
) -> Trainer:
    store = TutoringStore(tmp_path / "tutoring")
    for episode in bar_episodes():
        store.add(episode)
    trainer = Trainer(VMDNNRecipe(small_config(pretraining=1), QUESTIONS), store)
    trainer.epoch()
    return trainer


def test_acts_as_the_trained_network(
    trainer: Trainer, bar_episodes: Callable[..., Sequence[Episode]]
) -> None:
    trainer.epoch()
    policy = NetworkPolicy.from_bytes(trainer.policy_bytes(4))
    assert (policy.name, policy.version) == ("experiment1", 4)
    images = bar_episodes()[1].images
    with torch.no_grad():
        outputs = (
            trainer.recipe.network(torch.from_numpy(vision_input(images))[None])[0].exp().numpy()
        )
    pfc = policy.states(images)["pfc"]
    for _ in range(2):  # every episode begins in the neutral state
        policy.begin({"object_y_m": 0.3}, 1)
        for step, image in enumerate(images):
            action = policy.step(image)
            assert action.shape == (11,)
            assert action.dtype == np.float64
            np.testing.assert_allclose(policy.outputs, outputs[step].ravel(), atol=1e-5)
            np.testing.assert_allclose(policy.pfc(), pfc[step], atol=1e-5)
            assert policy.outputs.dtype == np.float32


def test_actions_are_within_the_robots_limits(trainer: Trainer) -> None:
    trainer.epoch()
    with torch.no_grad():
        trainer.recipe.network.outputs.bias.view(11, 10)[:, -1] = 100  # all on the last unit
    policy = NetworkPolicy.from_bytes(trainer.policy_bytes(1))
    action = policy.step(np.zeros((48, 64), np.uint8))
    for value, number in zip(ACTION_VALUES, action, strict=True):
        assert value.minimum <= number <= value.maximum


def test_policy_and_training_checkpoint_both_act(trainer: Trainer, tmp_path: Path) -> None:
    trainer.epoch()
    policy_path, checkpoint_path = tmp_path / "policy.safetensors", tmp_path / "all.safetensors"
    policy_path.write_bytes(trainer.policy_bytes(2))
    trainer.save(checkpoint_path)
    assert policy_path.stat().st_size < checkpoint_path.stat().st_size
    image = np.full((48, 64), 77, np.uint8)
    actions = [NetworkPolicy.from_file(path).step(image) for path in (policy_path, checkpoint_path)]
    np.testing.assert_array_equal(*actions)


def test_pretraining_checkpoint_cannot_act(trainer: Trainer, tmp_path: Path) -> None:
    path = tmp_path / "early.safetensors"
    trainer.save(path)
    with pytest.raises(UserError, match=r"early.safetensors is from pre-training and cannot act"):
        NetworkPolicy.from_file(path)
    with pytest.raises(RuntimeError):
        trainer.policy_bytes(1)


def test_picture_of_another_size_is_refused(trainer: Trainer) -> None:
    trainer.epoch()
    policy = NetworkPolicy.from_bytes(trainer.policy_bytes(1))
    with pytest.raises(UserError, match=r"48 x 64 pictures .* not \(64, 48\)"):
        policy.step(np.zeros((64, 48), np.uint8))


def test_grey_values_become_brightness() -> None:
    grey = np.array([[0, 51, 255]], np.uint8)
    np.testing.assert_allclose(vision_input(grey), [[-1, -0.6, 1]], atol=1e-6)
    assert vision_input(grey).dtype == np.float32
