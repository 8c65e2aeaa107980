"""Writes and reads episodes: one lossless MCAP file each, which Foxglove can open.

| topic | schema | content |
|---|---|---|
| `/eye` | foxglove.CompressedImage | images[t] as PNG |
| `/joints` | foxglove.JointStates | joints_deg[t], in radians, the unit of the schema |
| `/tf` | foxglove.FrameTransforms | body_poses[t], each body a frame in `world` |
| `/states` | vmdnn.States | states[t] of each subnet; only if the episode has states |
| `/step` | vmdnn.Step | phases[t], actions[t], targets[t], outputs[t]; ends step t |

Step t has the log time t * control_period_s. All other fields are in four metadata records before
the first message: `episode`, `situation`, `outcome` and `measures`.
"""

from __future__ import annotations

import json
import struct
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from google.protobuf.message import DecodeError
from mcap.exceptions import InvalidMagic, McapError
from mcap.records import Channel, McapRecord, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from numpy.typing import NDArray
from zstandard import ZstdError

from proto.body import ACTION_NAMES, IMAGE_HEIGHT, IMAGE_WIDTH, JOINT_NAMES
from proto.episode import Episode, Floats, Image, Kind, Measure, Outcome
from proto.errors import UserError
from proto.recordings import format1
from proto.recordings.schemas import (
    CompressedImage,
    FrameTransforms,
    JointStates,
    Message,
    States,
    Step,
    describe,
)
from proto.storage import written_whole

FORMAT: Final = 2
"""Format of the files that are written; files of format 1 can be read too."""
EYE: Final = "/eye"
JOINTS: Final = "/joints"
TRANSFORMS: Final = "/tf"
STATES: Final = "/states"
STEP: Final = "/step"
TOPICS: Final[Mapping[str, type[Message]]] = {
    EYE: CompressedImage,
    JOINTS: JointStates,
    TRANSFORMS: FrameTransforms,
    STEP: Step,
}

_READINGS: Final = ("lenient", "strict", "precise")

# If the process is killed while it writes, at most one chunk is lost, about ten steps.
CHUNK_BYTES: Final = 64 * 1024
DAMAGE: Final = (
    McapError,
    ZstdError,
    struct.error,
    ValueError,
    KeyError,
    MemoryError,
    OverflowError,
)
"""Exceptions raised by reading the records of a truncated or damaged file."""


def write_episode(path: Path, episode: Episode) -> None:
    """Write an episode; the file appears under its name only when it is complete.

    Raises:
        UserError: the file cannot be written.
    """
    with written_whole(path) as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, enable_data_crcs=True)
        writer.start(profile="vmdnn", library="vmdnn")
        writer.add_metadata("episode", _episode_texts(episode))
        writer.add_metadata("situation", {k: json.dumps(v) for k, v in episode.situation.items()})
        writer.add_metadata("outcome", _outcome_texts(episode.outcome))
        writer.add_metadata("measures", _measure_texts(episode.outcome))
        topics = dict(TOPICS) if episode.states is None else {**TOPICS, STATES: States}
        channels = {topic: _register(writer, topic, schema) for topic, schema in topics.items()}
        for step in range(episode.steps):
            time_ns = round(step * episode.control_period_s * 1e9)
            for topic, message in _messages(episode, step, time_ns):
                data = message.SerializeToString()
                writer.add_message(channels[topic], time_ns, data, time_ns, sequence=step)
        writer.finish()  # type: ignore[no-untyped-call]


def read_episode(path: Path, *, partial: bool = False) -> Episode:
    """Read an episode that `write_episode` wrote.

    Args:
        path: the MCAP file.
        partial: accept an episode that `vmdnn recover` restored from a truncated file. It has
            fewer steps than were played, but the outcome of the whole episode.

    Raises:
        UserError: the file is missing, truncated, damaged, not an episode, or recovered in part.
    """
    contents = _contents(path)
    _check_format(path, contents)
    try:
        expected = int(contents.metadata["episode"]["steps"])
        episode = _episode(contents)
    except (KeyError, ValueError, TypeError, AttributeError, DecodeError) as error:
        raise _not_an_episode(path, error) from error
    if not partial:
        _check_steps(path, episode.steps, expected)
    return episode


def _not_an_episode(path: Path, error: Exception) -> UserError:
    return UserError(
        f"{path} is an MCAP file, but no episode that this version can read ({error!r})"
    )


def _check_steps(path: Path, steps: int, expected: int) -> None:
    if steps != expected:
        raise UserError(
            f"{path} holds {steps} of {expected} steps, recovered from a file that was cut "
            f"off. `vmdnn replay` can show it; for training or counting, play the episode again."
        )


@dataclass(frozen=True)
class EpisodeSummary:
    """The fields that identify a recorded episode; see `Episode`."""

    id: str
    kind: Kind
    task: str
    seed: int
    policy_version: int
    training: str


def read_summary(path: Path) -> EpisodeSummary:
    """Read the summary of an episode; check the whole file, but do not decode its steps.

    Raises:
        UserError: as `read_episode`.
    """
    contents = _contents(path)
    try:
        texts = contents.metadata["episode"]
        summary = EpisodeSummary(
            id=texts["id"],
            kind=Kind(texts["kind"]),
            task=texts["task"],
            seed=int(texts["seed"]),
            policy_version=int(texts["policy_version"]),
            training=texts.get("training", ""),
        )
        _check_steps(path, len(contents.messages[STEP]), int(texts["steps"]))
    except (KeyError, ValueError) as error:
        raise _not_an_episode(path, error) from error
    return summary


def records(path: Path) -> Iterator[McapRecord]:
    """Yield all records of an MCAP file in order; unpack chunks and verify checksums.

    Raises:
        UserError: the file cannot be read, or it is not an MCAP file.
        one of DAMAGE: the file is truncated or damaged after the last record that was yielded.
    """
    try:
        with path.open("rb") as stream:
            size = path.stat().st_size
            yield from StreamReader(stream, validate_crcs=True, record_size_limit=size).records
    except InvalidMagic as error:
        raise UserError(f"{path} is not an MCAP file") from error
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


@dataclass(frozen=True)
class _Contents:
    """Metadata by name, and the messages of each topic in order."""

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    messages: dict[str, list[bytes]] = field(default_factory=lambda: defaultdict(list))


def _contents(path: Path) -> _Contents:
    contents = _Contents()
    topics: dict[int, str] = {}
    try:
        for record in records(path):
            if isinstance(record, McapMessage):
                contents.messages[topics[record.channel_id]].append(record.data)
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Metadata):
                contents.metadata[record.name] = record.metadata
    except DAMAGE as error:
        raise UserError(
            f"{path} is cut off or damaged; run `vmdnn recover {path}` to save what is whole of it"
        ) from error
    return contents


def _register(writer: Writer, topic: str, schema: type[Message]) -> int:
    name = schema.DESCRIPTOR.full_name
    schema_id = writer.register_schema(name, "protobuf", describe(schema))
    return writer.register_channel(topic, "protobuf", schema_id)


def _messages(episode: Episode, step: int, time_ns: int) -> Iterator[tuple[str, Message]]:
    eye = CompressedImage(format="png", frame_id="left_eye", data=_png(episode.images[step]))
    joints = JointStates()
    for name, angle in zip(JOINT_NAMES, _radians(episode.joints_deg[step]), strict=True):
        joints.joints.add(name=name, position=angle)
    transforms = FrameTransforms()
    for name, pose in zip(episode.body_names, episode.body_poses[step].tolist(), strict=True):
        transform = transforms.transforms.add(parent_frame_id="world", child_frame_id=name)
        transform.timestamp.FromNanoseconds(time_ns)
        position, rotation = transform.translation, transform.rotation
        position.x, position.y, position.z = pose[:3]
        rotation.w, rotation.x, rotation.y, rotation.z = pose[3:]
    step_message = Step(
        step=step,
        phase=int(episode.phases[step]) + 1,
        phase_name=episode.phase_names[episode.phases[step]],
        action=dict(zip(ACTION_NAMES, episode.actions[step].tolist(), strict=True)),
        target=dict(zip(ACTION_NAMES, episode.targets[step].tolist(), strict=True)),
        outputs=[] if episode.outputs is None else episode.outputs[step].tolist(),
    )
    eye.timestamp.FromNanoseconds(time_ns)
    joints.timestamp.FromNanoseconds(time_ns)
    yield from ((EYE, eye), (JOINTS, joints), (TRANSFORMS, transforms))
    if episode.states is not None:
        states = States()
        for name, activity in episode.states.items():
            states.subnets.add(name=name, activity=activity[step].tolist())
        yield STATES, states
    yield STEP, step_message


def _episode(contents: _Contents) -> Episode:
    texts = contents.metadata["episode"]
    names = tuple(json.loads(texts["body_names"]))
    # `/step` is the last message of a step, so a step with a `/step` message is complete.
    steps = [Step.FromString(data) for data in contents.messages[STEP]]
    count = len(steps)
    outputs_size = json.loads(texts["outputs"])
    return Episode(
        id=texts["id"],
        kind=Kind(texts["kind"]),
        task=texts["task"],
        situation={k: json.loads(v) for k, v in contents.metadata["situation"].items()},
        seed=int(texts["seed"]),
        actor=texts["actor"],
        backend=texts["backend"],
        policy=texts["policy"],
        policy_version=int(texts["policy_version"]),
        config_digest=texts["config_digest"],
        images=_images(contents.messages[EYE][:count]),
        actions=_floats([_action(step.action) for step in steps], (count, len(ACTION_NAMES))),
        targets=_floats([_action(step.target) for step in steps], (count, len(ACTION_NAMES))),
        joints_deg=_joints_deg(contents.messages[JOINTS][:count]),
        phase_names=_phase_names(texts),
        phases=np.array([step.phase - 1 for step in steps], dtype=np.uint8),
        body_names=names,
        body_poses=_poses(contents.messages[TRANSFORMS][:count], len(names)),
        outcome=_outcome(contents.metadata),
        outputs=None
        if outputs_size is None
        else _floats([step.outputs for step in steps], (count, outputs_size)),
        control_period_s=float(texts["control_period_s"]),
        states=_states(contents.messages[STATES][:count], json.loads(texts.get("states", "null"))),
        training=texts.get("training", ""),  # older recordings do not have this field
    )


def _episode_texts(episode: Episode) -> dict[str, str]:
    return {
        "format": str(FORMAT),
        "id": episode.id,
        "kind": episode.kind.value,
        "task": episode.task,
        "seed": str(episode.seed),
        "actor": episode.actor,
        "backend": episode.backend,
        "policy": episode.policy,
        "policy_version": str(episode.policy_version),
        "training": episode.training,
        "config_digest": episode.config_digest,
        "control_period_s": repr(episode.control_period_s),
        "steps": str(episode.steps),
        "phase_names": json.dumps(episode.phase_names),
        **_states_text(episode),
        "outputs": json.dumps(None if episode.outputs is None else episode.outputs.shape[1]),
        "body_names": json.dumps(episode.body_names),
    }


def _states_text(episode: Episode) -> dict[str, str]:
    """Number of units by subnet; no entry if the episode has no states, as in older files."""
    if episode.states is None:
        return {}
    units = {name: activity.shape[1] for name, activity in episode.states.items()}
    return {"states": json.dumps(units)}


def _outcome_texts(outcome: Outcome) -> dict[str, str]:
    readings = {name: json.dumps(getattr(outcome, name)) for name in _READINGS}
    return readings | {"reason": outcome.reason}


def _measure_texts(outcome: Outcome) -> dict[str, str]:
    return {
        name: json.dumps([measure.value, measure.unit])
        for name, measure in outcome.measures.items()
    }


def _outcome(metadata: Mapping[str, Mapping[str, str]]) -> Outcome:
    texts = metadata["outcome"]
    if _format_of(metadata) == 1:
        reason = {"reason": texts["reason"]}
        return format1.outcome_of(
            {k: json.loads(v) for k, v in texts.items() if k != "reason"} | reason
        )
    lenient, strict, precise = (bool(json.loads(texts[name])) for name in _READINGS)
    measured = ((name, json.loads(text)) for name, text in metadata["measures"].items())
    measures = {name: Measure(float(value), str(unit)) for name, (value, unit) in measured}
    return Outcome(lenient, strict, precise, texts["reason"], measures)


def _phase_names(texts: Mapping[str, str]) -> tuple[str, ...]:
    if texts["format"] == "1":
        return format1.phase_names()
    return tuple(str(name) for name in json.loads(texts["phase_names"]))


def _check_format(path: Path, contents: _Contents) -> None:
    """Refuse a file whose format is newer than this version of vmdnn."""
    try:
        number = _format_of(contents.metadata)
    except (KeyError, ValueError):
        return  # not an episode: reading its fields raises the error
    if number > FORMAT:
        raise UserError(
            f"{path} is of format {number}, written by a newer vmdnn; this one reads formats up to"
            f" {FORMAT}: update vmdnn to read it"
        )


def _format_of(metadata: Mapping[str, Mapping[str, str]]) -> int:
    return int(metadata["episode"]["format"])


def _png(image: Image) -> bytes:
    encoded, data = cv2.imencode(".png", image)
    if not encoded:
        raise ValueError(f"an image of shape {image.shape} cannot be encoded as PNG")
    return bytes(data)


def _images(messages: Sequence[bytes]) -> Image:
    images = np.empty((len(messages), IMAGE_HEIGHT, IMAGE_WIDTH), dtype=np.uint8)
    for step, data in enumerate(messages):
        png = np.frombuffer(CompressedImage.FromString(data).data, dtype=np.uint8)
        image = cv2.imdecode(png, cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise ValueError(f"the picture of step {step} is not a PNG")
        images[step] = image
    return images


def _states(messages: Sequence[bytes], units: Mapping[str, int] | None) -> dict[str, Floats] | None:
    if units is None:
        return None
    rows: dict[str, list[Sequence[float]]] = {name: [] for name in units}
    for data in messages:
        for subnet in States.FromString(data).subnets:
            rows[subnet.name].append(subnet.activity)
    return {name: _floats(rows[name], (len(messages), size)) for name, size in units.items()}


def _radians(joints_deg: Floats) -> list[float]:
    # In float64, so that converting back to degrees and rounding to float32 is exact.
    radians: list[float] = np.radians(joints_deg.astype(np.float64)).tolist()
    return radians


def _joints_deg(messages: Sequence[bytes]) -> Floats:
    radians = [
        [joint.position for joint in JointStates.FromString(data).joints] for data in messages
    ]
    return np.degrees(_array(radians, (len(messages), len(JOINT_NAMES)))).astype(np.float32)


def _action(action: Any) -> list[float]:
    return [getattr(action, name) for name in ACTION_NAMES]


def _poses(messages: Sequence[bytes], bodies: int) -> Floats:
    poses = []
    for data in messages:
        for transform in FrameTransforms.FromString(data).transforms:
            position, rotation = transform.translation, transform.rotation
            poses.append(
                (
                    *(position.x, position.y, position.z),
                    *(rotation.w, rotation.x, rotation.y, rotation.z),
                )
            )
    return _floats(poses, (len(messages), bodies, 7))


def _floats(rows: Sequence[Sequence[float]], shape: tuple[int, ...]) -> Floats:
    return _array(rows, shape).astype(np.float32)


def _array(rows: Sequence[Sequence[float]], shape: tuple[int, ...]) -> NDArray[np.float64]:
    return np.array(rows, dtype=np.float64).reshape(shape)
