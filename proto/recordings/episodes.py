"""Writes and reads episodes: one lossless MCAP file each, which Foxglove can open.

Each step t has messages on these topics. Its log time is started_s + t * control_period_s.

| topic | schema | content |
|---|---|---|
| `/eye` | foxglove.CompressedImage | images[t] as PNG |
| `/eye/calibration` | foxglove.CameraCalibration | view.focal_px[t] |
| `/joints` | foxglove.JointStates | joints_deg[t] and velocities, in radians, the schema's unit |
| `/tf` | foxglove.FrameTransforms | body_poses[t], bodies in `world`; then fixed frames |
| `/states` | vmdnn.States | states[t] of each subnet; only if the episode has states |
| `/step` | vmdnn.Step | phases[t], actions[t], targets[t], outputs[t]; ends step t |

What only viewers need comes once (see `proto.recordings.viewing`): `/boxes`, `/robot`, `/events`.
All other fields are in metadata records before the first message: `episode`, `situation`,
`outcome`, `measures` and, if the episode has a view, `boxes` and `fixed_links`.
"""

from __future__ import annotations

import json
import struct
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from google.protobuf.message import DecodeError
from mcap.records import Channel, Header, Metadata
from mcap.records import Message as McapMessage
from mcap.writer import Writer
from numpy.typing import NDArray

from proto.body import ACTION_NAMES, IMAGE_HEIGHT, IMAGE_WIDTH, JOINT_NAMES
from proto.episode import (
    BODIES,
    PHASES,
    STEPS,
    BoxLook,
    Episode,
    Floats,
    Image,
    Kind,
    Measure,
    Outcome,
    View,
)
from proto.errors import UserError
from proto.plain_text import plain
from proto.reading import read_limited
from proto.recordings import format1, viewing
from proto.recordings.mcap_records import (
    LARGEST_FILE,
    DamageError,
    NotMcapError,
    TooMuchError,
    whole_records,
)
from proto.recordings.schemas import (
    ACTION_FIELDS,
    CameraCalibration,
    CompressedImage,
    FrameTransforms,
    JointStates,
    Log,
    Message,
    SceneUpdate,
    States,
    Step,
    describe,
)
from proto.storage import written_whole
from proto.suites import Conditions
from proto.variables import Situation

FORMAT: Final = 3
"""Format of the files that are written; files of formats 1 and 2 can be read too."""
EYE: Final = "/eye"
CALIBRATION: Final = "/eye/calibration"
JOINTS: Final = "/joints"
TRANSFORMS: Final = "/tf"
STATES: Final = "/states"
STEP: Final = "/step"
BOXES: Final = "/boxes"
ROBOT: Final = "/robot"
EVENTS: Final = "/events"
SCHEMAS: Final[Mapping[str, type[Message]]] = {
    EYE: CompressedImage,
    CALIBRATION: CameraCalibration,
    JOINTS: JointStates,
    TRANSFORMS: FrameTransforms,
    STATES: States,
    STEP: Step,
    BOXES: SceneUpdate,
    ROBOT: SceneUpdate,
    EVENTS: Log,
}

_READINGS: Final = ("lenient", "strict", "precise")

# If the process is killed while it writes, at most one chunk is lost, about ten steps.
CHUNK_BYTES: Final = 64 * 1024
_BROKEN: Final = (
    LookupError,
    ValueError,
    TypeError,
    AttributeError,
    RecursionError,
    OverflowError,
    DecodeError,
    cv2.error,
)
"""What reading the values of a damaged or foreign episode raises."""

# Limits of what is read, far above what is written.
_LARGEST_MESSAGE: Final = 2**20
_LARGEST_PNG: Final = 2**16
_PNG_BEGINS: Final = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + struct.pack(
    ">II", IMAGE_WIDTH, IMAGE_HEIGHT
)
"""Begin of a PNG of the size of the eye's pictures."""
_MOST_STEPS: Final = STEPS.most
_MOST_POSES: Final = 2**18
_MOST_UNITS: Final = 65_536
_BEGINNING_BYTES: Final = 2**18
"""The metadata of an episode are within so many bytes from the beginning of its file."""


class _Told(NamedTuple):
    """A message to be written: its topic, step, log time (ns) and serialized content."""

    topic: str
    step: int
    time_ns: int
    data: bytes


def write_episode(path: Path, episode: Episode, *, robot: SceneUpdate | None = None) -> None:
    """Write an episode; the file appears under its name only when it is complete.

    Args:
        path: the file.
        episode: the episode.
        robot: the robot's meshes in the frames of its links, so that viewers show it; None leaves
            them out. `services.robot_meshes` has them.

    Raises:
        UserError: the file cannot be written.
    """
    with written_whole(path) as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, enable_data_crcs=True)
        writer.start(profile="vmdnn", library="vmdnn")
        for name, texts in _metadata(episode):
            writer.add_metadata(name, texts)
        channels: dict[str, int] = {}
        for told in _messages(episode, robot):
            if told.topic not in channels:
                channels[told.topic] = _register(writer, told.topic)
            channel = channels[told.topic]
            writer.add_message(channel, told.time_ns, told.data, told.time_ns, sequence=told.step)
        writer.finish()  # type: ignore[no-untyped-call]


def read_episode(path: Path, *, partial: bool = False) -> Episode:
    """Read an episode that `write_episode` wrote.

    Args:
        path: the MCAP file.
        partial: accept an episode that `vmdnn recover` restored from a truncated file. It has
            fewer steps than were played, but the outcome of the whole episode.

    Raises:
        UserError: the file is missing, truncated, damaged, not an episode, recovered in part, or
            without any step that was played.
    """
    contents = _contents(path)
    _check_format(path, contents)
    try:
        expected = int(contents.metadata["episode"]["steps"])
        episode = _episode(contents)
    except _BROKEN as error:
        raise _not_an_episode(path, error) from error
    _check_steps(path, episode.steps, expected, partial=partial)
    return episode


def _not_an_episode(path: Path, error: Exception) -> UserError:
    return UserError(
        f"{path} is an MCAP file, but no episode that this version can read"
        f" ({plain(repr(error), 300)})"
    )


def _check_steps(path: Path, steps: int, expected: int, *, partial: bool = False) -> None:
    if expected and not steps:
        raise UserError(
            f"{path} holds none of the {plain(expected, 20)} steps that were played; play the"
            " episode again"
        )
    if steps != expected and not partial:
        raise UserError(
            f"{path} holds {steps} of {plain(expected, 20)} steps, recovered from a file that"
            " was cut off. `vmdnn replay` can show it; for training or counting, play the episode"
            " again."
        )


@dataclass(frozen=True)
class EpisodeSummary:
    """The fields of a recorded episode that tell whether a run can use it; see `Episode`."""

    id: str
    kind: Kind
    task: str
    situation: Situation
    seed: int
    policy_version: int
    training: str
    conditions: Conditions | None
    control_period_s: float
    phases: NDArray[np.uint8]
    actions: Floats
    targets: Floats
    outcome: Outcome


def read_summary(path: Path) -> EpisodeSummary:
    """Read the summary of an episode; check the whole file, but do not decode its pictures.

    Raises:
        UserError: as `read_episode`.
    """
    contents = _contents(path)
    try:
        texts = contents.metadata["episode"]
        steps = _steps(contents)
        _check_steps(path, len(steps), int(texts["steps"]))
        shape = (len(steps), len(ACTION_NAMES))
        return EpisodeSummary(
            id=texts["id"],
            kind=Kind(texts["kind"]),
            task=texts["task"],
            situation={k: json.loads(v) for k, v in contents.metadata["situation"].items()},
            seed=int(texts["seed"]),
            policy_version=int(texts["policy_version"]),
            training=texts.get("training", ""),
            conditions=_conditions(texts),
            control_period_s=float(texts["control_period_s"]),
            phases=np.array([step.phase - 1 for step in steps], dtype=np.uint8),
            actions=_floats([_action(step.action) for step in steps], shape),
            targets=_floats([_action(step.target) for step in steps], shape),
            outcome=_outcome(contents.metadata),
        )
    except _BROKEN as error:
        raise _not_an_episode(path, error) from error


@dataclass(frozen=True)
class EpisodeHeading:
    """What the beginning of a recording says of the episode; see `Episode`.

    Attributes:
        steps: number of control steps that were played.
    """

    id: str
    kind: Kind
    task: str
    situation: Situation
    seed: int
    actor: str
    backend: str
    policy: str
    policy_version: int
    conditions: Conditions | None
    outcome: Outcome
    started_s: float | None
    steps: int


def read_heading(path: Path) -> EpisodeHeading:
    """Read what a recording says of its episode; only the beginning of the file is read.

    Raises:
        UserError: it cannot be read.
    """
    metadata: dict[str, dict[str, str]] = {}
    try:
        with path.open("rb") as stream:
            beginning = stream.read(_BEGINNING_BYTES)
        for record in whole_records(beginning):
            if isinstance(record, Metadata):
                metadata[record.name] = record.metadata
            elif not isinstance(record, Header):
                break
        texts = metadata["episode"]
        return EpisodeHeading(
            id=texts["id"],
            kind=Kind(texts["kind"]),
            task=texts["task"],
            situation={k: json.loads(v) for k, v in metadata["situation"].items()},
            seed=int(texts["seed"]),
            actor=texts["actor"],
            backend=texts["backend"],
            policy=texts["policy"],
            policy_version=int(texts["policy_version"]),
            conditions=_conditions(texts),
            outcome=_outcome(metadata),
            started_s=_started_s(texts),
            steps=int(texts["steps"]),
        )
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except (DamageError, *_BROKEN) as error:
        problem = plain(error, 200)
        raise UserError(f"{path} is damaged, or no recording of an episode ({problem})") from error


@dataclass(frozen=True)
class _Contents:
    """Metadata by name, and the messages of each topic in order."""

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    messages: dict[str, list[bytes]] = field(default_factory=lambda: defaultdict(list))


def _contents(path: Path) -> _Contents:
    contents = _Contents()
    topics: dict[int, str] = {}
    try:
        for record in whole_records(read_limited(path, LARGEST_FILE)):
            if isinstance(record, McapMessage):
                contents.messages[topics[record.channel_id]].append(record.data)
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Metadata):
                contents.metadata[record.name] = record.metadata
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except NotMcapError as error:
        raise UserError(
            f"{path} is not an MCAP file, or its beginning is damaged; `vmdnn recover {path}` saves"
            " what is whole of a damaged one"
        ) from error
    except TooMuchError as error:
        raise UserError(
            f"{path} is no episode of vmdnn, or is damaged: {error}; `vmdnn recover {path}` saves"
            " what is whole of a damaged one"
        ) from error
    except (DamageError, KeyError) as error:
        raise UserError(
            f"{path} is cut off or damaged; run `vmdnn recover {path}` to save what is whole of it"
        ) from error
    return contents


def _steps(contents: _Contents) -> list[Any]:
    """Read all messages of `/step`, and check the sizes of all messages before others are read.

    `/step` is the last message of a step, so a step with a `/step` message is complete.
    """
    for topic in (EYE, CALIBRATION, JOINTS, TRANSFORMS, STATES, STEP):
        if any(len(data) > _LARGEST_MESSAGE for data in contents.messages[topic]):
            raise ValueError(f"{topic} has a message of more than {_LARGEST_MESSAGE} bytes")
    count = len(contents.messages[STEP])
    if count > _MOST_STEPS:
        raise ValueError(f"it has {count} steps; at most {_MOST_STEPS} are possible")
    return [Step.FromString(data) for data in contents.messages[STEP]]


def _register(writer: Writer, topic: str) -> int:
    schema = SCHEMAS[topic]
    name = schema.DESCRIPTOR.full_name
    schema_id = writer.register_schema(name, "protobuf", describe(schema))
    return writer.register_channel(topic, "protobuf", schema_id)


def _messages(episode: Episode, robot: SceneUpdate | None) -> Iterator[_Told]:
    """All messages of an episode, in the order of their times."""
    start_ns = round((episode.started_s or 0.0) * 1e9)
    if robot is not None:
        yield _Told(ROBOT, 0, start_ns, robot.SerializeToString())
    if episode.view is not None:
        boxes = viewing.boxes(episode.view.boxes, start_ns)
        yield _Told(BOXES, 0, start_ns, boxes.SerializeToString())
    steps = StepMessages(episode, start_ns)
    for step in range(episode.steps):
        time_ns = start_ns + round(step * episode.control_period_s * 1e9)
        if step == 0 or episode.phases[step] != episode.phases[step - 1]:
            begun = viewing.phase_event(episode.phase_names[episode.phases[step]], time_ns)
            yield _Told(EVENTS, step, time_ns, begun.SerializeToString())
        for topic, data in steps.of(step, time_ns):
            yield _Told(topic, step, time_ns, data)
    end_ns = start_ns + round(episode.steps * episode.control_period_s * 1e9)
    ended = viewing.outcome_event(episode.outcome, end_ns)
    yield _Told(EVENTS, episode.steps, end_ns, ended.SerializeToString())


class StepMessages:
    """Makes the messages of one step after the other; what stays the same is made only once."""

    def __init__(self, episode: Episode, start_ns: int, *, prefix: str = "") -> None:
        """Prepare.

        Args:
            episode: the episode.
            start_ns: when it began, Unix time (ns).
            prefix: beginning of the names of all frames.
        """
        self._episode = episode
        self._prefix = prefix
        self._joints_rad = np.radians(episode.joints_deg.astype(np.float64))
        self._velocities_rad_s = viewing.velocities(self._joints_rad, episode.control_period_s)
        self._joints = JointStates()
        for name in JOINT_NAMES:
            self._joints.joints.add(name=name)
        self._transforms = FrameTransforms()
        for name in episode.body_names:
            self._transforms.transforms.add(
                parent_frame_id=f"{prefix}{viewing.WORLD}", child_frame_id=f"{prefix}{name}"
            )
        # Repeated fields that are serialized one after the other are one list when they are read.
        fixed = viewing.fixed_transforms(episode.view, start_ns, prefix=prefix)
        self._fixed_transforms = bytes(fixed.SerializeToString())

    def of(self, step: int, time_ns: int) -> Iterator[tuple[str, bytes]]:
        """Topic and content of each message of a step."""
        episode = self._episode
        eye = CompressedImage(
            format="png",
            frame_id=f"{self._prefix}{viewing.CAMERA_FRAME}",
            data=_png(episode.images[step]),
        )
        viewing.set_time(eye.timestamp, time_ns)
        yield EYE, eye.SerializeToString()
        if episode.view is not None:
            focal_px = episode.view.focal_px[step].tolist()
            camera = viewing.calibration(focal_px, time_ns, prefix=self._prefix)
            yield CALIBRATION, camera.SerializeToString()
        yield JOINTS, self._joints_of(step, time_ns)
        yield TRANSFORMS, self._transforms_of(step, time_ns)
        if episode.states is not None:
            states = States()
            for name, activity in episode.states.items():
                states.subnets.add(name=name, activity=activity[step].tolist())
            yield STATES, states.SerializeToString()
        yield STEP, _step(episode, step).SerializeToString()

    def _joints_of(self, step: int, time_ns: int) -> bytes:
        viewing.set_time(self._joints.timestamp, time_ns)
        angles = self._joints_rad[step].tolist()
        velocities = self._velocities_rad_s[step].tolist()
        for joint, angle, velocity in zip(self._joints.joints, angles, velocities, strict=True):
            joint.position, joint.velocity = angle, velocity
        return bytes(self._joints.SerializeToString())

    def _transforms_of(self, step: int, time_ns: int) -> bytes:
        poses = self._episode.body_poses[step].tolist()
        for transform, pose in zip(self._transforms.transforms, poses, strict=True):
            viewing.set_time(transform.timestamp, time_ns)
            viewing.set_pose(transform, pose)
        return bytes(self._transforms.SerializeToString()) + self._fixed_transforms


def _step(episode: Episode, step: int) -> Message:
    return Step(
        step=step,
        phase=int(episode.phases[step]) + 1,
        phase_name=episode.phase_names[episode.phases[step]],
        action=dict(zip(ACTION_FIELDS, episode.actions[step].tolist(), strict=True)),
        target=dict(zip(ACTION_FIELDS, episode.targets[step].tolist(), strict=True)),
        outputs=[] if episode.outputs is None else episode.outputs[step].tolist(),
    )


def _episode(contents: _Contents) -> Episode:
    texts = contents.metadata["episode"]
    names = tuple(_names(texts["body_names"], BODIES.most))
    steps = _steps(contents)
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
        else _rows([step.outputs for step in steps], outputs_size),
        control_period_s=float(texts["control_period_s"]),
        states=_states(contents.messages[STATES][:count], json.loads(texts.get("states", "null"))),
        training=texts.get("training", ""),  # older recordings do not have this field
        started_s=_started_s(texts),
        view=_view(contents, count),
        conditions=_conditions(texts),
    )


def _metadata(episode: Episode) -> Iterator[tuple[str, dict[str, str]]]:
    """Name and texts of each metadata record."""
    yield "episode", _episode_texts(episode)
    yield "situation", {k: json.dumps(v) for k, v in episode.situation.items()}
    yield "outcome", _outcome_texts(episode.outcome)
    yield "measures", _measure_texts(episode.outcome)
    if episode.view is not None:
        yield "boxes", {k: json.dumps([v.size_m, v.colour]) for k, v in episode.view.boxes.items()}
        fixed = episode.view.fixed_links.items()
        yield "fixed_links", {name: json.dumps(pose.tolist()) for name, pose in fixed}


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
        **({} if episode.started_s is None else {"started_s": repr(episode.started_s)}),
        **_conditions_text(episode),
        "outputs": json.dumps(None if episode.outputs is None else episode.outputs.shape[1]),
        "body_names": json.dumps(episode.body_names),
    }


def _states_text(episode: Episode) -> dict[str, str]:
    """Number of units by subnet; no entry if the episode has no states, as in older files."""
    if episode.states is None:
        return {}
    units = {name: activity.shape[1] for name, activity in episode.states.items()}
    return {"states": json.dumps(units)}


def _started_s(texts: Mapping[str, str]) -> float | None:
    return float(texts["started_s"]) if "started_s" in texts else None


def _view(contents: _Contents, steps: int) -> View | None:
    """The view of an episode; None if it has none, as in files of formats 1 and 2."""
    if "fixed_links" not in contents.metadata:
        return None
    if len(contents.metadata["fixed_links"]) > BODIES.most:
        raise ValueError("it has too many fixed links")
    boxes = {name: json.loads(text) for name, text in contents.metadata["boxes"].items()}
    fixed = contents.metadata["fixed_links"].items()
    focal = []
    for data in contents.messages[CALIBRATION][:steps]:
        camera = CameraCalibration.FromString(data).K
        if len(camera) != 9:
            raise ValueError(f"a camera matrix has {len(camera)} numbers")
        focal.append((camera[0], camera[4]))
    return View(
        boxes={name: BoxLook(_axes(size), _axes(colour)) for name, (size, colour) in boxes.items()},
        fixed_links={name: _floats(json.loads(text), (7,)) for name, text in fixed},
        focal_px=_floats(focal, (steps, 2)),
    )


def _axes(values: Sequence[Any]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def _conditions_text(episode: Episode) -> dict[str, str]:
    """The conditions as JSON; no entry for those of the suite `unlearned`, as in older files."""
    if episode.conditions is None:
        return {}
    return {"conditions": json.dumps(asdict(episode.conditions))}


def _conditions(texts: Mapping[str, str]) -> Conditions | None:
    if "conditions" not in texts:
        return None
    values = json.loads(texts["conditions"])
    return Conditions(
        suite=str(values["suite"]),
        stretch=float(values["stretch"]),
        disturbance=str(values["disturbance"]),
        strength=float(values["strength"]),
    )


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
    return tuple(str(name) for name in _names(texts["phase_names"], PHASES.most))


def _names(text: str, most: int) -> list[Any]:
    names = json.loads(text)
    if not isinstance(names, list) or len(names) > most:
        raise ValueError(f"expected a list of at most {most} names")
    return names


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
        png = CompressedImage.FromString(data).data
        if len(png) > _LARGEST_PNG or not png.startswith(_PNG_BEGINS):
            raise ValueError(f"the picture of step {step} is no PNG of the eye's size")
        image = cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
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
    if any(len(rows[name]) != len(messages) for name in units):
        raise ValueError("a step lacks the states of a subnet")
    return {name: _rows(rows[name], size) for name, size in units.items()}


def _rows(rows: Sequence[Sequence[float]], size: int) -> Floats:
    """Values (T, size) of numbers of each step, of which there must be as many as told."""
    if not 0 <= size <= _MOST_UNITS or any(len(row) != size for row in rows):
        raise ValueError(f"a step has not {plain(size, 20)} numbers")
    values = np.empty((len(rows), size), dtype=np.float32)
    for step, row in enumerate(rows):
        values[step] = row
    return values


def _joints_deg(messages: Sequence[bytes]) -> Floats:
    # In float64, so that converting to degrees and rounding to float32 is exact.
    radians = np.empty((len(messages), len(JOINT_NAMES)), dtype=np.float64)
    for step, data in enumerate(messages):
        joints = JointStates.FromString(data).joints
        if len(joints) != len(JOINT_NAMES):
            raise ValueError(f"step {step} has {len(joints)} joints")
        radians[step] = [joint.position for joint in joints]
    return np.degrees(radians).astype(np.float32)


def _action(action: Any) -> list[float]:
    return [getattr(action, name) for name in ACTION_FIELDS]


def _poses(messages: Sequence[bytes], bodies: int) -> Floats:
    if bodies * len(messages) > _MOST_POSES:
        raise ValueError(f"it has more than {_MOST_POSES} poses")
    poses = np.empty((len(messages), bodies, 7), dtype=np.float32)
    for step, data in enumerate(messages):
        transforms = FrameTransforms.FromString(data).transforms
        if len(transforms) < bodies:
            raise ValueError(f"step {step} has {len(transforms)} of {bodies} bodies")
        for body in range(bodies):
            position, rotation = transforms[body].translation, transforms[body].rotation
            poses[step, body] = (
                *(position.x, position.y, position.z),
                *(rotation.w, rotation.x, rotation.y, rotation.z),
            )
    return poses


def _floats(rows: Sequence[Any], shape: tuple[int, ...]) -> Floats:
    return np.array(rows, dtype=np.float64).reshape(shape).astype(np.float32)
