"""Every epoch of a training is told once, with its stage, loss and learning rate."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from actors.tasks.registry import make_task
from learner.training.recent_epochs import RecentEpochs
from learner.training.trainer import Trainer
from learner.training.vmdnn_recipe import VMDNNRecipe
from learner.tutoring.store import TutoringStore
from proto.config import Config, TaskConfig
from proto.metrics import MOST_EPOCHS, Stage


def test_epochs_are_told_once(
    tmp_path: Path, small_config: Callable[..., Config], bar_episodes: Callable[..., list]
) -> None:
    store = TutoringStore(tmp_path)
    for episode in bar_episodes():
        store.add(episode)
    config = small_config(2, epochs=4, warmup_epochs=0, schedule="constant", rate=0.01)
    trainer = Trainer(VMDNNRecipe(config, make_task(TaskConfig()).questions), store)
    recent, losses = RecentEpochs(), []
    assert (recent.taken(), recent.learning_rate, trainer.learning_rate) == ((), None, None)
    for _ in range(3):
        losses.append(trainer.epoch())
        recent.note(trainer)
    told = recent.taken()
    assert [(each.stage, each.epoch) for each in told] == [
        (Stage.PRETRAINING, 1),
        (Stage.PRETRAINING, 2),
        (Stage.COUPLED, 1),
    ]
    assert [each.loss for each in told] == losses
    assert told[-1].learning_rate == recent.learning_rate == 0.01
    while not trainer.finished:
        trainer.epoch()
        recent.note(trainer)
    assert [(each.stage, each.epoch) for each in recent.taken()] == [
        (Stage.COUPLED, number) for number in (2, 3, 4)
    ]
    for _ in range(2 * MOST_EPOCHS):
        recent.note(trainer)
    assert len(recent.taken()) == MOST_EPOCHS
