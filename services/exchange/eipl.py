"""Data of EIPL (ogata-lab): `images.npy` and `joints.npy` in `train` and `test`, and their bounds.

| file | content |
|---|---|
| `train/images.npy`, `test/images.npy` | (N, T, height, width, 3) uint8 |
| `train/joints.npy`, `test/joints.npy` | (N, T, D) float32; here the eleven targets |
| `joint_bounds.npy` | (2, D) float32, minimum and maximum over both |

A shorter sequence repeats its last step. EIPL does not name joints.
"""

from __future__ import annotations

import tokenize
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from proto.body import ACTION_NAMES
from proto.episode import Episode
from proto.errors import UserError
from proto.plain_text import plain
from proto.storage import written_whole
from services.exchange.foreign import MOST_STEPS, check_picture, eye_picture, foreign_episode
from services.exchange.joint_map import JointMap

SETS: Final = ("train", "test")
_BROKEN: Final = (
    OSError,
    ValueError,
    TypeError,
    EOFError,
    SyntaxError,
    LookupError,
    RecursionError,
    OverflowError,
    MemoryError,
    zipfile.BadZipFile,
    tokenize.TokenError,
)
"""What reading a damaged file raises."""
_LEAST_RANGE: Final = 1e-2
"""Bounds that are nearer are widened: EIPL divides by the range of a joint."""


def export_eipl(episodes: Sequence[Episode], out: Path, test_share: float) -> dict[str, int]:
    """Write episodes as data of EIPL, and return the number of episodes in each set.

    Args:
        episodes: at least two situations; all repeats of a situation are in the same set.
        out: the folder.
        test_share: share of the situations in the set `test`, at least one.

    Raises:
        UserError: there is only one situation, or a file cannot be written.
    """
    sets = dict(zip(SETS, _split(episodes, test_share), strict=True))
    steps = max(episode.steps for episode in episodes)
    for name, chosen in sets.items():
        images = np.stack([_lengthened(episode.images, steps) for episode in chosen])
        _write(out / name / "images.npy", np.repeat(images[..., None], 3, axis=-1))
        joints = np.stack([_lengthened(episode.targets, steps) for episode in chosen])
        _write(out / name / "joints.npy", joints.astype(np.float32))
    _write(out / "joint_bounds.npy", _bounds(np.concatenate([e.targets for e in episodes])))
    return {name: len(chosen) for name, chosen in sets.items()}


def import_eipl(folder: Path, joint_map: JointMap | None, task: str) -> Iterator[Episode]:
    """Yield the sequences of both sets as tutoring sequences of a task.

    Args:
        folder: the folder that holds `train` and `test`, or one of them.
        joint_map: what the columns of the joints are; None if vmdnn exported them. Without `fps`
            it is 10.
        task: name of the task.

    Raises:
        UserError: it is no such folder, or its content does not fit.
    """
    found = [folder / name for name in SETS if (folder / name / "joints.npy").exists()]
    if not found:
        raise UserError(f"{folder} holds neither train/joints.npy nor test/joints.npy of EIPL")
    if joint_map is None:
        joint_map = JointMap(joints={n: n for n in ACTION_NAMES}, names=list(ACTION_NAMES))
    if joint_map.names is None:
        raise UserError(
            "data of EIPL do not name the joints: list them as `names` in the joint map"
        )
    for part in found:
        images, joints = _read(part / "images.npy"), _read(part / "joints.npy")
        _check(part, images, joints)
        for number, (pictures, values) in enumerate(zip(images, joints, strict=True)):
            steps = _steps_without_repetition(pictures, values)
            targets = joint_map.targets(
                values[:steps], joint_map.names, f"{part}, sequence {number}"
            )
            yield foreign_episode(
                np.stack([eye_picture(picture) for picture in pictures[:steps]]),
                targets,
                task=task,
                origin="eipl",
                fps=joint_map.fps or 10.0,
            )


def _split(episodes: Sequence[Episode], test_share: float) -> tuple[list[Episode], list[Episode]]:
    """Training and test set: every n-th situation, in the order of the episodes, is in the test."""
    groups: dict[Any, list[Episode]] = {}
    for episode in episodes:
        # Without a situation, a sequence is a group of its own.
        key = frozenset(episode.situation.items()) or episode.id
        groups.setdefault(key, []).append(episode)
    if len(groups) < 2:
        raise UserError("EIPL needs a training and a test set: export at least two situations")
    count = min(max(round(test_share * len(groups)), 1), len(groups) - 1)
    tested = {int(index) for index in np.linspace(0, len(groups) - 1, count + 2)[1:-1].round()}
    train: list[Episode] = []
    test: list[Episode] = []
    for number, group in enumerate(groups.values()):
        (test if number in tested else train).extend(group)
    return train, test


def _lengthened(values: NDArray[Any], steps: int) -> NDArray[Any]:
    """(T, ...) values, the last one repeated until there are `steps`."""
    return np.concatenate([values, np.repeat(values[-1:], steps - len(values), axis=0)])


def _steps_without_repetition(pictures: NDArray[Any], values: NDArray[Any]) -> int:
    """Number of steps without those at the end that only repeat the last one."""
    steps = len(values)
    while steps > 1 and np.array_equal(values[steps - 2], values[-1], equal_nan=False):
        if not np.array_equal(pictures[steps - 2], pictures[-1]):
            break
        steps -= 1
    return steps


def _bounds(values: NDArray[np.float32]) -> NDArray[np.float32]:
    low, high = values.min(axis=0), values.max(axis=0)
    widened = np.maximum(_LEAST_RANGE - (high - low), 0.0) / 2
    return np.stack([low - widened, high + widened]).astype(np.float32)


def _write(path: Path, array: NDArray[Any]) -> None:
    with written_whole(path) as stream:
        np.save(stream, array, allow_pickle=False)


def _read(path: Path) -> NDArray[Any]:
    try:
        return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))
    except _BROKEN as error:
        raise UserError(
            f"{path} cannot be read as an array of numpy: {plain(error, 300)}"
        ) from error


def _check(part: Path, images: NDArray[Any], joints: NDArray[Any]) -> None:
    if images.ndim != 5 or images.shape[-1] != 3 or images.dtype != np.uint8:
        raise UserError(
            f"{part / 'images.npy'} is {images.dtype} {images.shape}, not uint8 (N, T, height,"
            " width, 3)"
        )
    try:
        check_picture(*images.shape[2:4])
    except ValueError as error:
        raise UserError(f"{part / 'images.npy'}: {error}") from error
    if not 1 <= images.shape[1] <= MOST_STEPS:
        raise UserError(
            f"{part / 'images.npy'} has {images.shape[1]} steps; 1 to {MOST_STEPS} are possible"
        )
    if joints.dtype.kind not in "fiu":
        raise UserError(f"{part / 'joints.npy'} is {plain(joints.dtype, 100)}, not numbers")
    if joints.ndim != 3 or joints.shape[:2] != images.shape[:2]:
        raise UserError(
            f"{part / 'joints.npy'} is {joints.shape}, which does not fit the"
            f" {images.shape[0]} sequences of {images.shape[1]} steps of images.npy"
        )
