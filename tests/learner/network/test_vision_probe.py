"""The vision is scored on sequences that were not used for fitting."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from actors.tasks.experiment1.world import SUBTASKS
from learner.checkpoint import checkpoint_from_bytes, load_checkpoint
from learner.network.vision_probe import (
    PENALTIES,
    Vision,
    ridge_regression,
    score_classifier,
    score_regression,
)
from learner.training.trainer import Trainer
from learner.training.vmdnn_recipe import VMDNNRecipe
from learner.tutoring.store import TutoringStore
from proto.config import Config
from proto.episode import Episode
from proto.errors import UserError
from proto.variables import Question

QUESTIONS = (Question("object_y_m", 3), Question("object_yaw_deg", 5))

MakeEpisodes = Callable[..., Sequence[Episode]]
Array = NDArray[np.float64]
LEARNED = {"places": (0.0, 0.5, 1.0), "slopes": (-1.0, -0.5, 0.0, 0.5, 1.0), "steps": 12}
OTHERS = {"places": (0.25, 0.75), "slopes": (-0.25, 0.25), "steps": 12}


@pytest.fixture(scope="module")
def trainer(
    tmp_path_factory: pytest.TempPathFactory,
    small_config: Callable[..., Config],
    bar_episodes: MakeEpisodes,
) -> Trainer:
    """A training whose pre-training is over."""
    store = TutoringStore(tmp_path_factory.mktemp("tutoring"))
    for episode in bar_episodes(**LEARNED):
        store.add(episode)
    trainer = Trainer(VMDNNRecipe(small_config(pretraining=40), QUESTIONS), store)
    for _ in range(40):
        trainer.epoch()
    return trainer


@pytest.fixture
def vision(trainer: Trainer, tmp_path: Path) -> Vision:
    path = tmp_path / "pretraining.safetensors"
    trainer.save(path)
    return Vision(load_checkpoint(path))


def test_the_classifier_scores_the_situations_that_it_learned(
    vision: Vision, bar_episodes: MakeEpisodes
) -> None:
    learned = score_classifier(vision, bar_episodes(**LEARNED))
    assert [(answer.value, answer.classes) for answer in learned] == [
        ("object_y_m", 3),
        ("object_yaw_deg", 5),
    ]
    assert [answer.right for answer in learned] == [1.0, 1.0]
    assert learned[0].error < 0.01
    assert learned[1].error < 9
    # of a picture that it cannot know it does not know the answer
    nothing = [
        bar_episodes(places=(place,), slopes=(slope,))[0] for place in (0, 1) for slope in (-1, 1)
    ]
    for episode in nothing:
        episode.images[:] = 0
    assert score_classifier(vision, nothing)[0].error > 0.03


def test_a_policy_has_no_classifier(trainer: Trainer, bar_episodes: MakeEpisodes) -> None:
    trainer.epoch()
    policy = Vision(checkpoint_from_bytes(trainer.policy_bytes(1), "policy"))
    assert score_classifier(policy, bar_episodes()) == []
    assert score_regression(policy, bar_episodes(), bar_episodes())


def test_values_between_the_classes_can_be_read_from_the_vision(
    vision: Vision, bar_episodes: MakeEpisodes
) -> None:
    scores = score_regression(vision, bar_episodes(**LEARNED), bar_episodes(**OTHERS))
    assert {score.value for score in scores} == {"object_y_m", "object_yaw_deg"}
    assert list(dict.fromkeys(score.phase for score in scores)) == list(SUBTASKS)
    last = {score.value: score for score in scores if score.phase == "lift"}
    assert last["object_y_m"].blind_error == pytest.approx(0.025)
    assert last["object_y_m"].error < 0.4 * 0.025


def test_sequences_without_variation_have_no_scores(
    vision: Vision, bar_episodes: MakeEpisodes
) -> None:
    alike = bar_episodes(places=(0.5,), slopes=(0.5,))
    with pytest.raises(UserError, match="no varying value"):
        score_regression(vision, alike, bar_episodes())


def refitted(features: Array, values: Array, penalty: float, others: Array) -> Array:
    centred = features - features.mean(0)
    gram = centred.T @ centred + penalty * np.eye(features.shape[1])
    weights = np.linalg.solve(gram, centred.T @ (values - values.mean()))
    return values.mean() + (others - features.mean(0)) @ weights


@pytest.mark.parametrize("noise", [0.01, 0.3, 3.0])
def test_the_penalty_minimizes_the_leave_one_out_error(noise: float) -> None:
    random = np.random.default_rng(1)
    values = np.repeat([-45.0, -22.5, 0.0, 22.5, 45.0], 4)
    pattern = random.normal(size=7) / 45
    features = values[:, None] * pattern + noise * random.normal(size=(20, 7))
    others = random.normal(size=(6, 7))

    def error(penalty: float) -> float:
        kept = [(values != value, values == value) for value in np.unique(values)]
        return sum(
            np.square(refitted(features[k], values[k], penalty, features[o]) - values[o]).sum()
            for k, o in kept
        )

    scale = np.square(features - features.mean(0)).sum() / len(values)
    best = min(PENALTIES * scale, key=error)
    predicted = ridge_regression(features, values, others)
    np.testing.assert_allclose(predicted, refitted(features, values, best, others), rtol=1e-5)
