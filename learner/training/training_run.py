"""A whole training in one process, into the folder of a run, without the bus."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from learner.checkpoint import (
    load_checkpoint,
    policy_file,
    pretraining_file,
    previous_training_file,
    training_file,
)
from learner.policy_digests import note_digest
from learner.training.recipe import Recipe
from learner.training.trainer import Trainer
from learner.tutoring.store import TutoringStore
from proto.errors import UserError
from proto.metrics import Stage
from proto.storage import (
    StorageError,
    change_suffix,
    delete_file,
    link_file,
    parts_in,
    written_whole,
)

LOG = logging.getLogger(__name__)


def open_training(
    recipe: Recipe,
    folder: Path,
    store: TutoringStore,
    pretraining_store: TutoringStore | None = None,
    *,
    rounds: int = 0,
) -> Trainer:
    """Go on with the training in a run's folder, or start it if there is none.

    What a killed training left half written is deleted.

    If the newest checkpoint is damaged or gone, the one before is used: what was trained since then
    is trained again. The damaged file gets the suffix `.damaged`.

    Args:
        recipe: the network, and how it is trained.
        folder: the run's folder.
        store: sequences to learn from.
        pretraining_store: sequences for pre-training; without it, those of `store`.
        rounds: rounds of corrections. The number in the config does not count here: corrections
            need actors.

    Raises:
        UserError: the folder has a training of another network, or all its checkpoints are damaged.
    """
    _delete_unfinished_files(folder)
    path = _usable_training_file(folder)
    if path is not None:
        return Trainer.restore(path, recipe, store, pretraining_store, rounds=rounds)
    return Trainer(recipe, store, pretraining_store, rounds=rounds)


def _delete_unfinished_files(folder: Path) -> None:
    """Delete what killed trainings left half written; no other process writes to these folders."""
    own = (folder / name for name in ("tutoring", "pretraining", "checkpoints", "policies"))
    for place in (folder, *own):
        for unfinished in parts_in(place):
            delete_file(unfinished)


def _usable_training_file(folder: Path) -> Path | None:
    """The newest checkpoint that can be read; None if there never was one.

    Raises:
        UserError: there are checkpoints, but all are damaged.
    """
    newest, previous = training_file(folder), previous_training_file(folder)
    problem = f"{newest} is gone"
    if newest.exists():
        try:
            load_checkpoint(newest)
        except UserError as error:
            problem = str(error)
        else:
            return newest
    elif not previous.exists():
        return None
    try:
        load_checkpoint(previous)
    except UserError as error:
        raise UserError(
            f"{problem}, and there is no checkpoint before it that can be used. To start the "
            f"training anew with the same sequences, move the folder {newest.parent} away"
        ) from error
    LOG.warning("%s. The training goes on from the checkpoint before, %s", problem, previous)
    if newest.exists():
        change_suffix(newest, ".damaged")
    return previous


def save_training(trainer: Trainer, folder: Path) -> None:
    """Write everything that `open_training` needs; the checkpoint before is kept, too.

    Raises:
        StorageError: the file cannot be written there.
    """
    newest = training_file(folder)
    if newest.exists():
        link_file(newest, previous_training_file(folder))
    trainer.save(newest)


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
            save_training(trainer, folder)
    save_training(trainer, folder)


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

    A policy that is there is never overwritten: if it is the same, because a killed training was
    computed again, nothing is written; otherwise the next free version is taken.

    Raises:
        StorageError: it cannot be written there; the next call tries it again.
    """
    before = version = trainer.version
    while True:
        version += 1
        content, file = trainer.policy_bytes(version), policy_file(folder, version)
        damaged = file.with_suffix(".damaged").exists()
        if not file.exists() and not damaged:
            break
        if not damaged and file.read_bytes() == content:
            note_digest(file, content)
            return
        LOG.warning("policy %d exists already and is another one; it stays as it is", version)
    try:
        with written_whole(file) as stream:
            stream.write(content)
        note_digest(file, content)
    except StorageError:
        trainer.version = before
        raise
