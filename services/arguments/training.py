"""What the commands that train without the bus share: arguments and Ctrl-C."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from learner.tutoring.store import TutoringStore
from proto.errors import UserError


def add_training_data(parser: argparse.ArgumentParser) -> None:
    """Add --data and --pretraining-data."""
    parser.add_argument("--data", type=Path, required=True, help="folder of tutored sequences")
    parser.add_argument(
        "--pretraining-data",
        type=Path,
        help="folder of sequences for pre-training; without it, those of --data",
    )


def training_stores(arguments: argparse.Namespace) -> tuple[TutoringStore, TutoringStore | None]:
    """The sequences that the arguments of `add_training_data` name.

    Raises:
        UserError: a folder does not exist, or holds no sequence.
    """
    store = filled_store("--data", arguments.data)
    if arguments.pretraining_data is None:
        return store, None
    return store, filled_store("--pretraining-data", arguments.pretraining_data)


@contextmanager
def interruption() -> Iterator[Callable[[], bool]]:
    """Catch the first Ctrl-C, so that an epoch can end; the second one interrupts at once.

    Yields:
        A function that returns whether Ctrl-C was pressed.
    """
    pressed = False

    def note_ctrl_c(_signal: int, _frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = signal.signal(signal.SIGINT, note_ctrl_c)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)


def filled_store(option: str, folder: Path) -> TutoringStore:
    """The sequences in a folder that an option names.

    Raises:
        UserError: it does not exist, or holds no sequence.
    """
    if not folder.is_dir():
        raise UserError(f"{option} {folder} is no folder; record one with `vmdnn tutor --out DIR`")
    store = TutoringStore(folder)
    if not store.ids:
        raise UserError(
            f"{option} {folder} holds no sequence (*.mcap); record some with"
            " `vmdnn tutor --out DIR`"
        )
    return store
