from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from learner.checkpoint import checkpoint_from_bytes
from learner.network_policy import NetworkPolicy
from learner.training.coupled import CoupledTraining
from learner.training.trainer import Trainer
from learner.training.training_run import policy_is_due
from learner.training.vmdnn_recipe import VMDNNRecipe
from learner.tutoring.store import TutoringStore
from proto.body import ACTION_VALUES, ARM
from proto.config import Config
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.metrics import Stage
from proto.variables import Question

QUESTIONS = (Question("object_y_m", 3), Question("object_yaw_deg", 5))

WITHOUT_NOISE = {"vision_noise": 0.0, "interpolation": 0.0}
RANGES = np.array([value.maximum - value.minimum for value in ACTION_VALUES])

MakeConfig = Callable[..., Config]
MakeEpisodes = Callable[..., Sequence[Episode]]


@pytest.fixture
def store(tmp_path: Path, bar_episodes: MakeEpisodes) -> TutoringStore:
    store = TutoringStore(tmp_path / "tutoring")
    for episode in bar_episodes():
        store.add(episode)
    return store


def train(trainer: Trainer, epochs: int) -> list[float]:
    return [trainer.epoch() for _ in range(epochs)]


def same_network(one: Trainer, other: Trainer) -> bool:
    there = other.recipe.network.state_dict()
    return all(
        torch.equal(tensor, there[name]) for name, tensor in one.recipe.network.state_dict().items()
    )


def test_it_learns_to_distinguish_situations(
    store: TutoringStore, small_config: MakeConfig, bar_episodes: MakeEpisodes
) -> None:
    trainer = Trainer(
        VMDNNRecipe(small_config(pretraining=60, epochs=300, batch=60, **WITHOUT_NOISE), QUESTIONS),
        store,
    )
    train(trainer, 60)
    first, *_, last = train(trainer, 300)
    assert last < 0.15 * first
    assert isinstance(trainer.objective, CoupledTraining)
    assert trainer.objective.mean_errors()[ARM].mean() < 4

    policy = NetworkPolicy.from_bytes(trainer.policy_bytes(1))
    for episode in bar_episodes():
        policy.begin({}, 0)
        for image in episode.images:
            action = policy.step(image)
        # at the end, situations lie half of each joint's range apart
        assert (np.abs(action - episode.targets[-1]) < 0.12 * RANGES).all()


def test_stages_follow_each_other(store: TutoringStore, small_config: MakeConfig) -> None:
    trainer = Trainer(VMDNNRecipe(small_config(pretraining=2, epochs=3), QUESTIONS), store)
    seen = []
    while not trainer.finished:
        trainer.epoch()
        seen.append((trainer.stage, trainer.epochs_done, trainer.epochs_total))
    assert seen == [
        (Stage.PRETRAINING, 1, 2),
        (Stage.PRETRAINING, 2, 2),
        (Stage.COUPLED, 1, 3),
        (Stage.COUPLED, 2, 3),
        (Stage.FINISHED, 3, 3),
    ]


def test_coupled_training_does_not_change_the_vision(
    store: TutoringStore, small_config: MakeConfig
) -> None:
    trainer = Trainer(VMDNNRecipe(small_config(pretraining=1, epochs=3), QUESTIONS), store)
    at_first = {n: p.clone() for n, p in trainer.recipe.network.named_parameters()}
    trainer.epoch()
    formed = {n: p.clone() for n, p in trainer.recipe.network.named_parameters()}
    train(trainer, 3)
    for name, parameter in trainer.recipe.network.named_parameters():
        vision = name.startswith("mstnn")
        assert torch.equal(parameter, formed[name]) == vision, name
        assert torch.equal(at_first[name], formed[name]) != (vision or name.startswith("pfc.")) or (
            name == "pfc.feedback"
        ), name


def test_same_seed_same_network(store: TutoringStore, small_config: MakeConfig) -> None:
    config = small_config()
    other_seed = config.model_copy(update={"run": config.run.model_copy(update={"seed": 2})})
    trainers = [
        Trainer(VMDNNRecipe(given, QUESTIONS), store) for given in (config, config, other_seed)
    ]
    for trainer in trainers:
        train(trainer, 10)
    assert same_network(trainers[0], trainers[1])
    assert not same_network(trainers[0], trainers[2])


@pytest.mark.parametrize("interruptions", [[0], [2], [4], [5], [1, 3, 6, 9], [10]])
def test_resumed_training_is_bit_identical(
    store: TutoringStore, small_config: MakeConfig, tmp_path: Path, interruptions: list[int]
) -> None:
    config = small_config(pretraining=4, epochs=6)
    whole = Trainer(VMDNNRecipe(config, QUESTIONS), store)
    losses = train(whole, 10)

    path = tmp_path / "training.safetensors"
    trainer, resumed = Trainer(VMDNNRecipe(config, QUESTIONS), store), []
    for end in [*interruptions, 10]:
        resumed += train(trainer, end - len(resumed))
        trainer.save(path)
        trainer = Trainer.restore(path, VMDNNRecipe(config, QUESTIONS), TutoringStore(store.folder))
    assert resumed == losses
    assert trainer.finished
    assert same_network(trainer, whole)
    assert trainer.policy_bytes(1) == whole.policy_bytes(1)


def train_in_rounds(
    trainer: Trainer, store: TutoringStore, episodes: Sequence[Episode], end: int
) -> list[float]:
    """Train to an epoch; a correction comes in before each round."""
    losses = []
    while trainer.epochs_done < end:
        if trainer.round_begins:
            number = trainer.round
            between = {"object_y_m": 0.22 + 0.01 * number, "object_yaw_deg": 10.0}
            given = {"id": f"corrected-{number}", "kind": Kind.CORRECTION, "situation": between}
            store.add(replace(episodes[number], **given))
        losses.append(trainer.epoch())
    return losses


@pytest.mark.parametrize("interrupted_at", [2, 3, 4, 5, 6, 7])
def test_training_can_be_resumed_at_any_epoch_of_any_round(
    tmp_path: Path, small_config: MakeConfig, bar_episodes: MakeEpisodes, interrupted_at: int
) -> None:
    config = small_config(pretraining=0, epochs=3, corrections={"epochs": 2})
    stores = [TutoringStore(tmp_path / name) for name in ("whole", "interrupted")]
    for store in stores:
        for episode in bar_episodes():
            store.add(episode)
    whole = Trainer(VMDNNRecipe(config, QUESTIONS), stores[0], rounds=2)
    losses = train_in_rounds(whole, stores[0], bar_episodes(), 7)
    assert whole.finished
    assert (whole.epochs_total, whole.sequences) == (7, 6)

    trainer = Trainer(VMDNNRecipe(config, QUESTIONS), stores[1], rounds=2)
    before = train_in_rounds(trainer, stores[1], bar_episodes(), interrupted_at)
    path = tmp_path / "training.safetensors"
    trainer.save(path)
    again = TutoringStore(stores[1].folder)
    resumed = Trainer.restore(path, VMDNNRecipe(config, QUESTIONS), again, rounds=2)
    assert (resumed.round, resumed.round_begins) == (trainer.round, trainer.round_begins)
    assert before + train_in_rounds(resumed, again, bar_episodes(), 7) == losses
    assert resumed.finished
    assert resumed.policy_bytes(1) == whole.policy_bytes(1)


def test_each_round_has_its_own_schedule(store: TutoringStore, small_config: MakeConfig) -> None:
    config = small_config(pretraining=0, epochs=20, corrections={"epochs": 20})
    trainer = Trainer(VMDNNRecipe(config, QUESTIONS), store, rounds=1)

    def step() -> float:
        before = trainer.recipe.network.outputs.bias.detach().clone()
        trainer.epoch()
        return float((trainer.recipe.network.outputs.bias.detach() - before).abs().max())

    steps = [step() for _ in range(40)]
    assert trainer.finished
    for first in (0, 20):  # it rises to the third epoch, and falls to the last
        round_steps = steps[first : first + 20]
        assert round_steps[19] < 0.1 * round_steps[2]


def test_policies_of_each_round_store_the_numbers_of_cases_and_sequences(
    store: TutoringStore, small_config: MakeConfig, bar_episodes: MakeEpisodes
) -> None:
    config = small_config(
        pretraining=2, epochs=6, publish_every_epochs=4, corrections={"epochs": 5}
    )
    store.add(replace(bar_episodes()[0], id="the-same-case-again"))
    trainer = Trainer(VMDNNRecipe(config, QUESTIONS), store, rounds=2)
    due = []
    while not trainer.finished:
        train_in_rounds(trainer, store, bar_episodes(), trainer.epochs_done + 1)
        if policy_is_due(trainer):
            due.append(checkpoint_from_bytes(trainer.policy_bytes(len(due) + 1), "").metadata)
    assert [(policy.epoch, policy.cases, policy.sequences) for policy in due] == [
        (4, 4, 5),
        (6, 4, 5),
        (11, 5, 6),
        (16, 6, 7),
    ]
    # without actors there are no corrections, whatever the config says
    assert Trainer(VMDNNRecipe(config, QUESTIONS), store).epochs_total == 2
    offline = Trainer(
        VMDNNRecipe(small_config(pretraining=0, corrections={"rounds": 3}), QUESTIONS), store
    )
    assert offline.epochs_total == 6


def test_sequences_can_be_added_during_training(
    tmp_path: Path, small_config: MakeConfig, bar_episodes: MakeEpisodes
) -> None:
    config = small_config(pretraining=3, epochs=6)
    episodes = bar_episodes()
    store = TutoringStore(tmp_path / "tutoring")
    trainer = Trainer(VMDNNRecipe(config, QUESTIONS), store)
    with pytest.raises(UserError, match=r"holds no tutored sequence .*`vmdnn tutor`"):
        trainer.epoch()
    counts = []
    for episode in (episodes[3], episodes[0], None, None, episodes[2], None):
        if episode is not None:
            store.add(episode)
        trainer.epoch()
        counts.append((trainer.stage, trainer.sequences))
    assert counts == [
        (Stage.PRETRAINING, 1),
        (Stage.PRETRAINING, 2),
        (Stage.PRETRAINING, 2),
        (Stage.COUPLED, 2),
        (Stage.COUPLED, 3),
        (Stage.COUPLED, 3),
    ]
    # the order in which they came counts, and survives
    path = tmp_path / "training.safetensors"
    trainer.save(path)
    resumed = Trainer.restore(path, VMDNNRecipe(config, QUESTIONS), TutoringStore(store.folder))
    assert train(resumed, 3) == train(trainer, 3)
    assert same_network(resumed, trainer)


def test_ranges_of_the_code_are_fixed_at_the_start_of_coupled_training(
    tmp_path: Path,
    small_config: MakeConfig,
    bar_episodes: MakeEpisodes,
    caplog: pytest.LogCaptureFixture,
) -> None:
    store = TutoringStore(tmp_path / "tutoring")
    near, far = bar_episodes(places=(0.5, 1.0), slopes=(0.5,))
    store.add(near)
    trainer = Trainer(VMDNNRecipe(small_config(pretraining=0), QUESTIONS), store)
    trainer.epoch()
    before = trainer.policy_bytes(1)
    store.add(far)
    trainer.epoch()
    assert f"sequence {far.id}: neck_yaw goes" in caplog.text
    code = NetworkPolicy.from_bytes(before)._code
    np.testing.assert_array_equal(
        NetworkPolicy.from_bytes(trainer.policy_bytes(2))._code.maxima, code.maxima
    )


def test_pretraining_can_have_its_own_sequences(
    store: TutoringStore, tmp_path: Path, small_config: MakeConfig, bar_episodes: MakeEpisodes
) -> None:
    others = TutoringStore(tmp_path / "others")
    for episode in bar_episodes(places=(0.0, 0.5, 1.0), steps=12):
        others.add(episode)
    trainer = Trainer(VMDNNRecipe(small_config(pretraining=2), QUESTIONS), store, others)
    trainer.epoch()
    assert trainer.sequences == 6
    train(trainer, 2)
    assert trainer.sequences == 4


def test_pretraining_waits_for_its_own_sequences(
    store: TutoringStore, tmp_path: Path, small_config: MakeConfig
) -> None:
    trainer = Trainer(
        VMDNNRecipe(small_config(pretraining=1), QUESTIONS),
        store,
        TutoringStore(tmp_path / "others"),
    )
    assert trainer.next_stage is Stage.PRETRAINING
    with pytest.raises(UserError, match="others holds no tutored sequence"):
        trainer.epoch()


def test_sequences_of_different_lengths(
    tmp_path: Path, small_config: MakeConfig, bar_episodes: MakeEpisodes
) -> None:
    store = TutoringStore(tmp_path / "tutoring")
    short, *_ = bar_episodes(steps=10)
    *_, long = bar_episodes(steps=25)
    store.add(short)
    store.add(long)
    trainer = Trainer(VMDNNRecipe(small_config(), QUESTIONS), store)
    assert np.isfinite(train(trainer, 10)).all()


def test_sequences_that_cannot_be_learned_from_are_skipped(
    store: TutoringStore, small_config: MakeConfig, bar_episodes: MakeEpisodes
) -> None:
    episode = bar_episodes()[0]
    broken = episode.targets.copy()
    broken[3, 4] = np.nan
    store.add(replace(episode, id="trial", kind=Kind.TRIAL))
    store.add(replace(episode, id="other-task", task="reaching"))
    store.add(replace(episode, id="broken", targets=broken))
    trainer = Trainer(VMDNNRecipe(small_config(pretraining=1), QUESTIONS), store)
    trainer.epoch()
    trainer.epoch()
    assert trainer.sequences == 4


def test_without_usable_sequences_training_is_refused(
    tmp_path: Path, small_config: MakeConfig, bar_episodes: MakeEpisodes
) -> None:
    store = TutoringStore(tmp_path)
    store.add(replace(bar_episodes()[0], situation={"side": 1.0}))
    with pytest.raises(UserError, match=r"has no 'object_y_m' in its situation") as caught:
        Trainer(VMDNNRecipe(small_config(), QUESTIONS), store).epoch()
    assert "none of the 1 sequences" in str(caught.value)


def test_checkpoint_of_another_network_is_refused(
    store: TutoringStore, small_config: MakeConfig, tmp_path: Path
) -> None:
    path = tmp_path / "training.safetensors"
    Trainer(VMDNNRecipe(small_config(), QUESTIONS), store).save(path)
    with pytest.raises(UserError, match=r"network.pfc.units: 8 in the checkpoint, 20 in"):
        Trainer.restore(path, VMDNNRecipe(Config(), QUESTIONS), store)


def test_training_cannot_go_on_from_a_policy(
    store: TutoringStore, small_config: MakeConfig, tmp_path: Path
) -> None:
    config = small_config(pretraining=0)
    trainer = Trainer(VMDNNRecipe(config, QUESTIONS), store)
    trainer.epoch()
    path = tmp_path / "policy.safetensors"
    path.write_bytes(trainer.policy_bytes(1))
    with pytest.raises(UserError, match=r"is a policy: it can act, but"):
        Trainer.restore(path, VMDNNRecipe(config, QUESTIONS), store)


def test_more_epochs_prolong_a_finished_training(
    store: TutoringStore, small_config: MakeConfig, tmp_path: Path
) -> None:
    trainer = Trainer(VMDNNRecipe(small_config(pretraining=1, epochs=2), QUESTIONS), store)
    train(trainer, 3)
    path = tmp_path / "training.safetensors"
    trainer.save(path)
    longer = Trainer.restore(
        path, VMDNNRecipe(small_config(pretraining=1, epochs=4), QUESTIONS), store
    )
    assert (longer.stage, longer.epochs_done, longer.epochs_total) == (Stage.COUPLED, 2, 4)
    train(longer, 2)
    assert longer.finished


def test_diverging_training_is_reported_and_stops(
    store: TutoringStore, small_config: MakeConfig
) -> None:
    trainer = Trainer(VMDNNRecipe(small_config(pretraining=0), QUESTIONS), store)
    trainer.epoch()
    with torch.no_grad():
        trainer.recipe.network.outputs.bias[0] = torch.inf
    with pytest.raises(UserError, match=r"diverged .*: lower learner.rate"):
        trainer.epoch()
    assert trainer.epochs_done == 1


def test_pretraining_has_its_own_number_of_threads(
    store: TutoringStore, small_config: MakeConfig
) -> None:
    config = small_config(pretraining=1, threads=1)
    pretraining = config.learner.pretraining.model_copy(update={"threads": 2})
    learner = config.learner.model_copy(update={"pretraining": pretraining})
    trainer = Trainer(VMDNNRecipe(config.model_copy(update={"learner": learner}), QUESTIONS), store)
    trainer.epoch()
    assert torch.get_num_threads() == 2
    trainer.epoch()
    assert torch.get_num_threads() == 1
