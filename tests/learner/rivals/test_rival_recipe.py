"""The networks that VMDNN is compared with: their size, their training, and their actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

from learner.checkpoint import (
    NETWORK_PREFIX,
    Checkpoint,
    checkpoint_from_bytes,
    load_checkpoint,
    policy_file,
    training_file,
)
from learner.network.vision_input import vision_input
from learner.network.vmdnn import VMDNN
from learner.network_policy import NetworkPolicy
from learner.rivals.networks import make_rival, rival_config, weights_of
from learner.rivals.rival_policy import RivalPolicy
from learner.rivals.rival_recipe import make_recipe
from learner.training.trainer import Trainer
from learner.training.training_run import open_training, run_training
from learner.tutoring.store import TutoringStore
from proto.config import Config, RivalKind
from proto.episode import Episode
from proto.errors import UserError
from proto.variables import Question

KINDS = get_args(RivalKind)


@pytest.fixture
def store(tmp_path: Path, bar_episodes: Callable[..., Sequence[Episode]]) -> TutoringStore:
    store = TutoringStore(tmp_path / "tutoring")
    for episode in bar_episodes(steps=12):
        store.add(episode)
    return store


def open_rival(folder: Path, kind: RivalKind, store: TutoringStore, *epochs: int) -> Trainer:
    return open_training(make_recipe(config(*epochs), kind), folder, store)


def train(
    folder: Path,
    kind: RivalKind,
    store: TutoringStore,
    go_on: Callable[[float], bool] = lambda _: True,
) -> bool:
    trainer = open_rival(folder, kind, store)
    run_training(trainer, folder, go_on)
    return trainer.finished


def config(together: int = 3, epochs: int = 3) -> Config:
    rival = {"units": 12, "together_epochs": together, "epochs": epochs}
    return Config.model_validate(
        {
            "learner": {"batch": 2, "warmup_epochs": 1},
            "comparison": {"cnn_lstm": rival, "feed_forward": rival},
        }
    )


@pytest.mark.parametrize("kind", KINDS)
def test_it_has_about_as_many_weights_as_vmdnn(kind: RivalKind) -> None:
    whole = Config()
    rival = make_rival(kind, rival_config(whole.comparison, kind).units, whole.network)
    assert weights_of(rival) == pytest.approx(weights_of(VMDNN(whole.network)), rel=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_it_learns_to_use_the_pictures(
    kind: RivalKind,
    store: TutoringStore,
    tmp_path: Path,
    bar_episodes: Callable[..., Sequence[Episode]],
) -> None:
    trainer = open_rival(tmp_path, kind, store, 60, 10)
    while not trainer.finished:
        trainer.epoch()
    policy = RivalPolicy(checkpoint_from_bytes(trainer.policy_bytes(1), "the policy"), "the policy")
    for left, right in (bar_episodes(slopes=[slope], steps=12) for slope in (-1.0, 1.0)):
        ends = []
        for episode in (left, right):
            policy.begin({}, seed=0)
            ends.append([policy.step(image) for image in episode.images][-1])
        taught = (right.targets[-1] - left.targets[-1])[1::2]  # only these tell the place
        acted = (ends[1] - ends[0])[1::2]
        assert (acted > 0.1 * taught).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_stopped_training_continues_exactly(
    kind: RivalKind, store: TutoringStore, tmp_path: Path
) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert train(whole, kind, store)
    stops = 0
    while not train(parts, kind, store, lambda _: False):
        stops += 1
    assert stops == 5  # of 6 epochs in both stages
    assert policy_file(whole, 1).read_bytes() == policy_file(parts, 1).read_bytes()
    assert train(parts, kind, store), "nothing is left to do"
    policies = policy_file(whole, 1).parent.glob("*.safetensors")
    assert list(policies) == [policy_file(whole, 1)], "one policy, at the end"


def test_the_second_stage_does_not_change_the_vision(store: TutoringStore, tmp_path: Path) -> None:
    epochs = iter(range(1, 7))
    train(tmp_path, "cnn-lstm", store, lambda _: next(epochs) < 3)
    formed = load_checkpoint(training_file(tmp_path)).part(NETWORK_PREFIX)
    train(tmp_path, "cnn-lstm", store)
    final = load_checkpoint(policy_file(tmp_path, 1)).part(NETWORK_PREFIX)
    changed = {name for name in formed if not np.array_equal(formed[name], final[name])}
    assert changed == {name for name in formed if not name.startswith("eye.")}


@pytest.fixture
def trained(store: TutoringStore, tmp_path: Path) -> Callable[[RivalKind], Checkpoint]:
    def train_one_epoch(kind: RivalKind) -> Checkpoint:
        trainer = open_rival(tmp_path, kind, store)
        trainer.epoch()
        return checkpoint_from_bytes(trainer.policy_bytes(1), "the policy")

    return train_one_epoch


@pytest.mark.parametrize("kind", KINDS)
def test_acting_step_by_step_agrees_with_whole_sequences(
    kind: RivalKind,
    trained: Callable[[RivalKind], Checkpoint],
    bar_episodes: Callable[..., Sequence[Episode]],
) -> None:
    checkpoint = trained(kind)
    images = np.concatenate([each.images[:4] for each in bar_episodes(steps=12)])
    network = make_rival(kind, 12, Config().network)
    network.load_state_dict(
        {name: torch.tensor(value) for name, value in checkpoint.part(NETWORK_PREFIX).items()}
    )
    whole = network.act(network.see(torch.from_numpy(vision_input(images))[None]))[0][0].exp()
    policy = RivalPolicy(checkpoint, "the policy")
    for _ in range(2):  # it forgets from one episode to the next
        policy.begin({}, seed=0)
        for image, outputs in zip(images, whole.detach().numpy(), strict=True):
            action = policy.step(image)
            assert action.shape == (11,)
            assert policy.outputs is not None
            np.testing.assert_allclose(policy.outputs, outputs.ravel(), atol=1e-5)


def test_only_the_lstm_remembers(
    trained: Callable[[RivalKind], Checkpoint], bar_episodes: Callable[..., Sequence[Episode]]
) -> None:
    seen, other = (episode.images[0] for episode in bar_episodes()[::3])
    for kind, remembers in (("cnn-lstm", True), ("feed-forward", False)):
        policy = RivalPolicy(trained(kind), "the policy")
        actions = []
        for before in (seen, other):
            policy.begin({}, seed=0)
            policy.step(before)
            actions.append(policy.step(seen))
        assert np.array_equal(*actions) != remembers


def test_foreign_and_damaged_networks_are_refused(
    trained: Callable[[RivalKind], Checkpoint], store: TutoringStore, tmp_path: Path
) -> None:
    checkpoint = trained("cnn-lstm")
    with pytest.raises(UserError, match="is no VMDNN, but the cnn-lstm network"):
        NetworkPolicy(checkpoint, "it")
    rest = {name: tensor for name, tensor in checkpoint.tensors.items() if "eye" not in name}
    with pytest.raises(UserError, match="does not hold what its metadata describes"):
        RivalPolicy(Checkpoint(checkpoint.metadata, rest), "it")
    train(tmp_path, "cnn-lstm", store, lambda _: False)
    with pytest.raises(UserError, match="cnn-lstm with 12 units, not feed-forward with 12 units"):
        train(tmp_path, "feed-forward", store)
    with pytest.raises(UserError, match="cnn-lstm with 12 units, not VMDNN"):
        open_training(make_recipe(config(), None, [Question("object_y_m", 3)]), tmp_path, store)
