"""Networks and training states in files and messages: safetensors with checked metadata.

A *policy* is a network and what it takes to act with it. A *training checkpoint* is a policy file
with more in it: optimizer, random state and place in the training. Either can act.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from learner.network.softmax_code import SoftmaxCode
from learner.network.subnets import parameter_shapes
from learner.pretrained import checkpoint_path
from proto.body import ACTION_SIZE, IMAGE_HEIGHT, IMAGE_WIDTH
from proto.config import NetworkConfig, RivalKind, Units
from proto.errors import UserError
from proto.messages import LARGEST_VERSION
from proto.metrics import Stage
from proto.plain_text import plain, plain_lines
from proto.reading import read_limited
from proto.storage import written_whole

Tensors = Mapping[str, NDArray[np.generic]]

_METADATA_KEY: Final = "vmdnn"
NETWORK_PREFIX: Final = "network."
CLASSIFIER_PREFIX: Final = "classifier."
_WINDOW_OF_FORMAT_1: Final = (0.75, 1.0)
_LARGEST_WEIGHT: Final = 1e6
"""With weights of at most this magnitude no sum in the network leaves float32."""
_WIDEST_CODE: Final = 1e4
"""Largest magnitude of an end of the range of an action value (degrees, or levels)."""
_LARGEST_HEADER: Final = 8 * 2**20
"""Size of the names, shapes and metadata in a file (bytes)."""
_MOST_VALUES: Final = 2000
"""Values in the metadata, the ids of sequences not counted."""
_MOST_SEQUENCES: Final = 100_000
LARGEST_FILE: Final = 2 * 2**30
"""Size of a file: the weights of the largest network, with what training keeps for each."""
_BROKEN: Final = (
    SafetensorError,
    ValueError,  # also what pydantic and json raise
    TypeError,
    AttributeError,
    RecursionError,
    OverflowError,
    MemoryError,
)
"""What reading damaged or foreign bytes raises."""


Classes = tuple[float, ...] | tuple[str, ...]
"""The classes of a variable: centres of a continuous one, choices of a discrete one."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


CodeEnd = Annotated[float, Field(ge=-_WIDEST_CODE, le=_WIDEST_CODE, allow_inf_nan=False)]
RunName = Annotated[str, Field(max_length=256, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
Version = Annotated[int, Field(ge=0, le=LARGEST_VERSION)]
Natural = Annotated[int, Field(ge=0, le=2**31)]


class CodeRanges(_Model):
    """Ranges of the action values that the outputs code, fixed when coupled training starts."""

    minima: tuple[CodeEnd, ...]
    maxima: tuple[CodeEnd, ...]

    @model_validator(mode="after")
    def _is_of_actions(self) -> Self:
        if not len(self.minima) == len(self.maxima) == ACTION_SIZE:
            raise ValueError(f"the code is not for {ACTION_SIZE} action values")
        if any(low >= high for low, high in zip(self.minima, self.maxima, strict=True)):
            raise ValueError("the code has a range that is empty")
        return self


class AskedMetadata(_Model):
    """A question of pre-training.

    Attributes:
        classes: classes of the answer.
        window: in which part of a sequence it is asked, see `proto.variables.Question`.
    """

    classes: Classes
    window: tuple[float, float]


class TrainingMetadata(_Model):
    """What only a training checkpoint has beside its tensors.

    Attributes:
        sequences: ids of the tutored sequences, in the order in which they were taken.
        asked: what pre-training asks, by name of the variable; empty in coupled training.
    """

    sequences: tuple[str, ...]
    asked: dict[str, AskedMetadata]


class RivalMetadata(_Model):
    """A network of another kind than VMDNN; see `learner.rivals`.

    Attributes:
        kind: which kind.
        units: of its LSTM or its hidden layer.
    """

    kind: RivalKind
    units: Units


class CheckpointMetadata(_Model):
    """What a checkpoint says about itself.

    Attributes:
        format: version of this format. Format 1 did not name task and simulator.
        run: name of the run.
        version: policy version; 0 before the first policy.
        stage: stage of the training.
        epoch: epochs of that stage that are done.
        loss: loss of the last of them, or None.
        config_digest: digest of the effective configuration.
        task: task that it was trained for; None where format 1 did not say.
        backend: simulator whose pictures it was trained on; None where format 1 did not say.
        network: the network; of a rival only its outputs count.
        code: ranges of the outputs; None as long as the network cannot act.
        cases: different situations that this stage has learned from; 0 if that was not counted.
        sequences: sequences that it has learned from; 0 if that was not counted.
        training: None in a policy.
        rival: None for VMDNN.
    """

    format: Literal[1, 2] = 2
    run: RunName
    version: Version
    stage: Stage
    epoch: Natural
    loss: float | None
    config_digest: str
    task: str | None = None
    backend: str | None = None
    network: NetworkConfig
    code: CodeRanges | None
    cases: Natural = 0
    sequences: Natural = 0
    training: TrainingMetadata | None = None
    rival: RivalMetadata | None = None

    def softmax_code(self) -> SoftmaxCode | None:
        """The code of the outputs, or None as long as the network cannot act."""
        if self.code is None:
            return None
        minima, maxima = np.array(self.code.minima), np.array(self.code.maxima)
        return SoftmaxCode.of_ranges(minima, maxima, self.network)


@dataclass(frozen=True)
class Checkpoint:
    """A policy or a training state.

    Attributes:
        metadata: what it is.
        tensors: arrays by name; the network's begin with `network.`.
    """

    metadata: CheckpointMetadata
    tensors: Tensors

    def part(self, prefix: str) -> dict[str, NDArray[np.generic]]:
        """The tensors whose names begin with prefix, named without it."""
        return {
            name.removeprefix(prefix): tensor
            for name, tensor in self.tensors.items()
            if name.startswith(prefix)
        }


def checkpoint_bytes(checkpoint: Checkpoint) -> bytes:
    """The checkpoint as the bytes of a safetensors file."""
    tensors = {name: np.ascontiguousarray(tensor) for name, tensor in checkpoint.tensors.items()}
    return save_tensors(tensors, {_METADATA_KEY: checkpoint.metadata.model_dump_json()})


def checkpoint_from_bytes(blob: bytes, origin: str) -> Checkpoint:
    """Read and check the bytes of a safetensors file.

    Args:
        blob: the bytes.
        origin: where they came from, for messages.

    Raises:
        UserError: they are damaged, foreign, or their tensors do not fit their own metadata.
    """
    header_size = int.from_bytes(blob[:8], "little")
    if header_size > _LARGEST_HEADER:
        raise UserError(
            f"{origin} is not a checkpoint, or is damaged (its header is said to have"
            f" {header_size} bytes); take another one"
        )
    try:
        tensors = load_tensors(blob)
        notes = json.loads(blob[8 : 8 + header_size]).get("__metadata__") or {}
        text = notes.get(_METADATA_KEY)
    except (*_BROKEN, KeyError) as error:
        raise UserError(
            f"{origin} is not a checkpoint, or is damaged ({plain(error, 300)}); take another one"
        ) from error
    if text is None:
        raise UserError(
            f"{origin} is a safetensors file, but not of vmdnn: it lacks the metadata"
            f" {_METADATA_KEY!r}"
        )
    checkpoint = Checkpoint(_metadata(text, origin), tensors)
    _check_tensors(checkpoint, origin)
    return checkpoint


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; the file appears under its name only once it is whole.

    Raises:
        UserError: the file cannot be written there.
    """
    with written_whole(path) as stream:
        stream.write(checkpoint_bytes(checkpoint))


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint: a file, or one that comes with the package (`pretrained:NAME`).

    Raises:
        UserError: the file is missing, damaged or foreign.
    """
    try:
        blob = read_limited(checkpoint_path(path), LARGEST_FILE)
    except OSError as error:
        raise UserError(f"checkpoint {path} cannot be read: {error.strerror}") from error
    return checkpoint_from_bytes(blob, f"checkpoint {path}")


def check_same_network(wanted: NetworkConfig, checkpoint: Checkpoint, origin: str) -> None:
    """Refuse a checkpoint of another network.

    Raises:
        UserError: the networks differ; the message names each field and both values.
    """
    here, there = _fields(wanted), _fields(checkpoint.metadata.network)
    differences = [
        f"  {name}: {there[name]} in the checkpoint, {here[name]} in the config"
        for name in here
        if here[name] != there[name]
    ]
    if differences:
        raise UserError(
            f"{origin} is of another network:\n"
            + "\n".join(differences)
            + "\nUse the config that it was trained with, or start a run of another name."
        )


def _fields(network: NetworkConfig) -> dict[str, object]:
    """All values by their full name, such as `network.pfc.tau`."""
    fields: dict[str, object] = {}
    for name, value in network:
        if isinstance(value, BaseModel):
            fields |= {f"network.{name}.{inner}": held for inner, held in value}
        else:
            fields[f"network.{name}"] = value
    return fields


def _metadata(text: str, origin: str) -> CheckpointMetadata:
    try:
        values = json.loads(text)
        _check_size(values)
        if isinstance(values, dict) and values.get("format", 1) == 1:
            _convert_format_1(values, origin)
        return CheckpointMetadata.model_validate(values)
    except (*_BROKEN, KeyError) as error:
        raise UserError(
            f"{origin} was written by another version of vmdnn, or is damaged:"
            f" {plain_lines(error)[:2000]}"
        ) from error


def _check_size(values: Any) -> None:
    """Refuse metadata that are too large, before each value that does not fit becomes an error.

    Raises:
        ValueError: they are too large.
    """
    left, todo = _MOST_VALUES, [values]
    training = values.get("training") if isinstance(values, dict) else None
    ids = training.get("sequences") if isinstance(training, dict) else None
    if isinstance(ids, list):
        if len(ids) > _MOST_SEQUENCES or not all(isinstance(each, str) for each in ids):
            raise ValueError(f"training.sequences are not at most {_MOST_SEQUENCES} ids")
        left += len(ids)
    while todo:
        value = todo.pop()
        items = list(value.values()) if isinstance(value, dict) else value
        if isinstance(items, list):
            left -= len(items)
            todo += items if items is not ids else []
        if left < 0:
            raise ValueError(f"they have more than {_MOST_VALUES} values")


def _convert_format_1(values: dict[str, Any], origin: str) -> None:
    """Drop the image size, which format 1 may name, and give each question its window."""
    size = values.get("network", {}).pop("image", [IMAGE_WIDTH, IMAGE_HEIGHT])
    if size != [IMAGE_WIDTH, IMAGE_HEIGHT]:
        raise UserError(
            f"{origin} is of a network for images of the size {plain(size, 100)} (width, height),"
            " but the"
            f" robot's images are {IMAGE_WIDTH} x {IMAGE_HEIGHT}; take another checkpoint"
        )
    training = values.get("training")
    if training is not None:
        training["asked"] = {
            name: {"classes": classes, "window": _WINDOW_OF_FORMAT_1}
            for name, classes in training.pop("classes", {}).items()
        }


def _check_tensors(checkpoint: Checkpoint, origin: str) -> None:
    network = checkpoint.part(NETWORK_PREFIX)
    shapes = {name: tensor.shape for name, tensor in network.items()}
    wanted = parameter_shapes(checkpoint.metadata.network)
    if checkpoint.metadata.rival is None and shapes != wanted:
        wrong = sorted(
            name for name in shapes.keys() | wanted.keys() if shapes.get(name) != wanted.get(name)
        )
        name = wrong[0]
        raise UserError(
            f"{origin} does not hold the network that its metadata describes:"
            f" {plain(name, 100)} has shape"
            f" {shapes.get(name)}, not {wanted.get(name)}"
        )
    for name, tensor in network.items():
        if tensor.dtype != np.float32 or not np.isfinite(tensor).all():
            raise UserError(f"{origin}: {plain(name, 100)} is not all finite float32 numbers")
        if tensor.size and max(-float(tensor.min()), float(tensor.max())) > _LARGEST_WEIGHT:
            raise UserError(
                f"{origin}: {plain(name, 100)} has weights that exceed {_LARGEST_WEIGHT:g}"
            )


def training_file(run_folder: Path) -> Path:
    """Where a run keeps its newest training checkpoint."""
    return run_folder / "checkpoints" / "training.safetensors"


def previous_training_file(run_folder: Path) -> Path:
    """Where a run keeps the training checkpoint before the newest one."""
    return run_folder / "checkpoints" / "training-before.safetensors"


def pretraining_file(run_folder: Path) -> Path:
    """Where a run keeps the training as it was when pre-training was over, with its classifier."""
    return run_folder / "checkpoints" / "pretraining.safetensors"


def policy_file(run_folder: Path, version: int) -> Path:
    """Where a run keeps a policy version."""
    return run_folder / "policies" / f"{version:06d}.safetensors"
