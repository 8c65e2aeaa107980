"""`vmdnn train`: train a network on recorded sequences."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from actors.tasks.registry import make_pretraining_task, make_task
from learner.checkpoint import policy_file, training_file
from learner.training.coupled import CoupledTraining
from learner.training.trainer import Trainer
from learner.training.training_run import open_training, run_training
from learner.training.vmdnn_recipe import VMDNNRecipe
from learner.tutoring.store import TutoringStore
from proto.body import ARM, FOCUS, GRASP, NECK
from proto.config import Config
from proto.metrics import Stage
from proto.run_locks import owned_training
from services.arguments.common import add_config, config_of
from services.arguments.training import add_training_data, interruption, training_stores
from services.monitoring.training_monitor import monitored
from services.terminal.console import make_console

_INTERRUPTED: Final = 130
_LINE_PERIOD_S: Final = 5.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    parser.epilog = "Corrections need actors, so learner.corrections has no effect here."
    add_config(parser)
    add_training_data(parser)
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the run; a run in it is continued"
    )


def run(arguments: argparse.Namespace) -> int:
    """Train until the end or Ctrl-C; the run's folder then contains checkpoints and policies."""
    config = config_of(arguments)
    store, others = training_stores(arguments)
    with owned_training(arguments.out):
        return _train(config, arguments.out, store, others)


def _train(config: Config, folder: Path, store: TutoringStore, others: TutoringStore | None) -> int:
    task = make_task(config.task)
    pretraining_task = task if others is None else make_pretraining_task(config)
    recipe = VMDNNRecipe(config, pretraining_task.questions, task.distractors)
    trainer = open_training(recipe, folder, store, others)
    config.save(folder / "config.yaml")
    if trainer.finished:
        print(
            f"{folder} is trained already; to continue, set learner.epochs above"
            f" {trainer.epochs_done}"
        )
        return 0
    with (
        interruption() as interrupted,
        _progress(trainer) as show,
        monitored(trainer, folder) as monitor,
    ):

        def go_on(loss: float) -> bool:
            show(loss)
            monitor.note_epoch()
            return not interrupted()

        run_training(trainer, folder, go_on)
    if not trainer.finished:
        print(f"stopped; the same command continues from {training_file(folder)}")
        return _INTERRUPTED
    _print_summary(trainer, folder)
    return 0


@contextmanager
def _progress(trainer: Trainer) -> Iterator[Callable[[float], None]]:
    """Yield a function that shows an epoch, given its loss.

    On a terminal it updates a progress bar; elsewhere it prints a line every few seconds.
    """
    console = make_console()
    if not console.is_terminal:
        yield _line_printer(trainer)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("loss {task.fields[loss]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("", loss="-")

        def show(loss: float) -> None:
            progress.update(
                bar,
                description=f"{_stage(trainer)} on {trainer.sequences} sequences",
                completed=trainer.epochs_done,
                total=trainer.epochs_total,
                loss=f"{loss:.5f}",
            )

        yield show


def _line_printer(trainer: Trainer) -> Callable[[float], None]:
    last = time.monotonic()
    epochs = 0

    def show(loss: float) -> None:
        nonlocal last, epochs
        epochs += 1
        elapsed = time.monotonic() - last
        stage_over = trainer.epochs_done == trainer.epochs_total
        if elapsed < _LINE_PERIOD_S and not stage_over:
            return
        print(
            f"{_stage(trainer)} epoch {trainer.epochs_done}/{trainer.epochs_total}"
            f" loss {loss:.5f} sequences {trainer.sequences} {elapsed / epochs:.3f} s/epoch",
            flush=True,
        )
        last, epochs = time.monotonic(), 0

    return show


def _stage(trainer: Trainer) -> Stage:
    return Stage.COUPLED if trainer.finished else trainer.stage


def _print_summary(trainer: Trainer, folder: Path) -> None:
    objective = trainer.objective
    if not isinstance(objective, CoupledTraining):
        raise TypeError("a finished training has the objective of coupled training")
    errors = objective.mean_errors()
    print(
        f"trained on {trainer.sequences} sequences: loss {trainer.loss:.5f}; mean error with the"
        f" tutor's pictures: neck {errors[NECK].mean():.2f} deg, arm {errors[ARM].mean():.2f} deg,"
        f" grasp level {errors[GRASP]:.2f}, focus level {errors[FOCUS]:.2f}"
    )
    print(f"policy {trainer.version}: {policy_file(folder, trainer.version)}")
