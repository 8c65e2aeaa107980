"""A whole training in one process, into the folder of a run, without the bus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from learner.checkpoint import policy_file, pretraining_file, training_file
from learner.training.trainer import Trainer
from learner.tutoring.store import TutoringStore
from proto.config import Config, LearnerConfig
from proto.metrics import Stage
from proto.storage import written_whole
from proto.variables import Question


def open_training(
    config: Config,
    folder: Path,
    store: TutoringStore,
    pretraining_store: TutoringStore | None,
    *,
    questions: Sequence[Question],
    rounds: int = 0,
) -> Trainer:
    """Go on with the training of a run's folder, or start it where there is none.

    `questions` is what pre-training asks about the situations of its task.

    Without actors there are no corrections, so there are no rounds of them unless they are asked
    for, whatever the configuration says.

    Raises:
        UserError: the folder has a training of another network, or a damaged one.
    """
    path = training_file(folder)
    if path.exists():
        return Trainer.restore(
            path, config, store, pretraining_store, questions=questions, rounds=rounds
        )
    return Trainer(config, store, pretraining_store, questions=questions, rounds=rounds)


def run_training(
    trainer: Trainer, config: LearnerConfig, folder: Path, go_on: Callable[[float], bool]
) -> None:
    """Train to the end, writing checkpoints and policies as the config says.

    A checkpoint is also written when it stops. What is written between two checkpoints is written
    again, the same, if the process was killed in between.

    Args:
        trainer: what is trained.
        config: how often to write.
        folder: the run's folder.
        go_on: called with the loss after each epoch; False stops the training.
    """
    going = True
    while going and not trainer.finished:
        going = go_on(trainer.epoch())
        if pretraining_is_over(trainer):
            trainer.save(pretraining_file(folder))
        if policy_is_due(trainer, config):
            write_policy(trainer, folder)
        if trainer.epochs_done % config.checkpoint_every_epochs == 0:
            trainer.save(training_file(folder))
    trainer.save(training_file(folder))


def pretraining_is_over(trainer: Trainer) -> bool:
    """Whether the epoch that was just done was the last one of pre-training."""
    return trainer.next_stage is not trainer.stage


def policy_is_due(trainer: Trainer, config: LearnerConfig) -> bool:
    """Whether the epoch that was just done gives a policy.

    In the first lap every so many epochs do, and in all laps the last one.
    """
    if trainer.finished or trainer.round_begins:
        return True
    first_lap = trainer.stage is Stage.COUPLED and trainer.round == 0
    return first_lap and trainer.epochs_done % config.publish_every_epochs == 0


def write_policy(trainer: Trainer, folder: Path) -> None:
    """Write the network as the next policy version into the run's folder.

    Raises:
        UserError: the file cannot be written there.
    """
    version = trainer.version + 1
    with written_whole(policy_file(folder, version)) as stream:
        stream.write(trainer.policy_bytes(version))
