"""A whole training in one process, into the folder of a run, without the bus."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from learner.checkpoint import policy_file, pretraining_file, training_file
from learner.training.recipe import Recipe
from learner.training.trainer import Trainer
from learner.tutoring.store import TutoringStore
from proto.metrics import Stage
from proto.storage import written_whole


def open_training(
    recipe: Recipe,
    folder: Path,
    store: TutoringStore,
    pretraining_store: TutoringStore | None = None,
    *,
    rounds: int = 0,
) -> Trainer:
    """Go on with the training in a run's folder, or start it if there is none.

    Args:
        recipe: the network, and how it is trained.
        folder: the run's folder.
        store: sequences to learn from.
        pretraining_store: sequences for pre-training; without it, those of `store`.
        rounds: rounds of corrections. The number in the config does not count here: corrections
            need actors.

    Raises:
        UserError: the folder has a training of another network, or a damaged one.
    """
    path = training_file(folder)
    if path.exists():
        return Trainer.restore(path, recipe, store, pretraining_store, rounds=rounds)
    return Trainer(recipe, store, pretraining_store, rounds=rounds)


def run_training(trainer: Trainer, folder: Path, go_on: Callable[[float], bool]) -> None:
    """Train to the end; write checkpoints and policies as the config says.

    A checkpoint is also written when the training stops. After a kill, everything since the last
    checkpoint is computed and written again, with the same result.

    Args:
        trainer: the training.
        folder: the run's folder.
        go_on: called with the loss after each epoch; False stops the training.
    """
    checkpoint_every = trainer.recipe.config.learner.checkpoint_every_epochs
    going = True
    while going and not trainer.finished:
        going = go_on(trainer.epoch())
        if pretraining_is_over(trainer):
            trainer.save(pretraining_file(folder))
        if policy_is_due(trainer):
            write_policy(trainer, folder)
        if trainer.epochs_done % checkpoint_every == 0:
            trainer.save(training_file(folder))
    trainer.save(training_file(folder))


def pretraining_is_over(trainer: Trainer) -> bool:
    """Whether the last epoch was the last one of pre-training."""
    return trainer.next_stage is not trainer.stage


def policy_is_due(trainer: Trainer) -> bool:
    """Whether the last epoch gives a policy.

    The last epoch of every round does; in round 0 also every `publish_every_epochs`-th epoch.
    """
    if trainer.finished or trainer.round_begins:
        return True
    every = trainer.recipe.publish_every_epochs
    initial_round = trainer.stage is Stage.COUPLED and trainer.round == 0
    return initial_round and every is not None and trainer.epochs_done % every == 0


def write_policy(trainer: Trainer, folder: Path) -> None:
    """Write the network as the next policy version into the run's folder.

    Raises:
        UserError: the file cannot be written there.
    """
    version = trainer.version + 1
    with written_whole(policy_file(folder, version)) as stream:
        stream.write(trainer.policy_bytes(version))
