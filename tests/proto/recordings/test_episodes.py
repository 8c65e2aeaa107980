"""An episode is read back unchanged, or an error says what to do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import message_factory
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as stn
from mcap.reader import make_reader
from mcap.writer import Writer

from proto.body import ACTION_SIZE, IMAGE_HEIGHT, IMAGE_WIDTH, JOINT_NAMES
from proto.episode import NO_FAILURE, BoxLook, Episode, Kind, Measure, Outcome, View
from proto.errors import UserError
from proto.recordings.episodes import EpisodeSummary, read_episode, read_summary, write_episode
from proto.suites import Conditions
from sim_assets.hand import MOTOR_NAMES

OUTPUTS = 110
STARTED_S = 1_700_000_000.25
DATA = Path(__file__).parents[2] / "data"


MakeEpisode = Callable[..., Episode]


def conditions() -> st.SearchStrategy[Conditions | None]:
    strength = st.floats(10, 30)
    pushed = st.builds(
        Conditions, st.text(max_size=8), st.floats(1, 3), st.just("pushed"), strength
    )
    return st.none() | pushed


def floats(*shape: int) -> st.SearchStrategy[np.ndarray]:
    return stn.arrays(np.float32, shape, elements=st.floats(width=32))


@st.composite
def outcomes(draw: st.DrawFn) -> Outcome:
    best = draw(st.integers(0, 3))
    readings = [level < best for level in range(3)]
    reason = NO_FAILURE if best == 3 else draw(st.sampled_from(("not_lifted", "imprecise")))
    measure = st.builds(Measure, st.floats(), st.text(max_size=4))
    return Outcome(
        *readings, reason, draw(st.dictionaries(st.text(max_size=8), measure, max_size=4))
    )


@st.composite
def views(draw: st.DrawFn, steps: int) -> View:
    word = st.text(max_size=8)
    axes = st.tuples(*[st.floats(0.0, 9.0)] * 3)
    return View(
        boxes=draw(st.dictionaries(word, st.builds(BoxLook, axes, axes), max_size=2)),
        fixed_links=draw(st.dictionaries(word, floats(7), max_size=2)),
        focal_px=draw(floats(steps, 2)),
    )


@st.composite
def episodes(draw: st.DrawFn) -> Episode:
    steps = draw(st.integers(0, 4))
    names = draw(st.lists(st.text(max_size=8), max_size=3))
    word = st.text(max_size=12)
    phases = draw(st.lists(word, min_size=1, max_size=255))
    return Episode(
        id=draw(word),
        kind=draw(st.sampled_from(Kind)),
        task=draw(word),
        situation=draw(st.dictionaries(word, st.floats() | word, max_size=3)),
        seed=draw(st.integers(0, 2**64)),
        actor=draw(word),
        backend=draw(word),
        policy=draw(word),
        policy_version=draw(st.integers(0, 10**6)),
        config_digest=draw(word),
        images=draw(stn.arrays(np.uint8, (steps, IMAGE_HEIGHT, IMAGE_WIDTH))),
        actions=draw(floats(steps, ACTION_SIZE)),
        targets=draw(floats(steps, ACTION_SIZE)),
        joints_deg=draw(floats(steps, len(JOINT_NAMES))),
        phase_names=tuple(phases),
        phases=draw(stn.arrays(np.uint8, (steps,), elements=st.integers(0, len(phases) - 1))),
        body_names=tuple(names),
        body_poses=draw(floats(steps, len(names), 7)),
        outcome=draw(outcomes()),
        outputs=draw(st.none() | floats(steps, OUTPUTS)),
        control_period_s=draw(st.floats(0.001, 10.0)),
        states=draw(st.none() | st.dictionaries(word, floats(steps, 7), max_size=3)),
        training=draw(word),
        started_s=draw(st.none() | st.floats(0.0, 1e10)),
        view=draw(st.none() | views(steps)),
        conditions=draw(conditions()),
    )


def same(one: object, other: object) -> bool:
    """Equal to the last bit, where NaN equals NaN."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(
            one, other, equal_nan=one.dtype.kind == "f"
        )
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, Outcome | View) and isinstance(other, Outcome | View):
        return same(vars(one), vars(other))
    return type(one) is type(other) and repr(one) == repr(other)


@settings(max_examples=60)
@given(episode=episodes())
def test_every_field_is_read_back_exactly(
    episode: Episode, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("round") / "episode.mcap"
    write_episode(path, episode)
    again = read_episode(path)
    for item in fields(Episode):
        assert same(getattr(again, item.name), getattr(episode, item.name)), item.name
    summary = read_summary(path)
    for item in fields(EpisodeSummary):
        assert same(getattr(summary, item.name), getattr(episode, item.name)), item.name


def test_an_episode_without_states_has_no_states_in_its_file(
    tmp_path: Path, make_episode: MakeEpisode
) -> None:
    path = tmp_path / "episode.mcap"
    write_episode(path, make_episode(3))
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        assert "/states" not in {channel.topic for channel in summary.channels.values()}
        (texts,) = (r.metadata for r in make_reader(stream).iter_metadata() if r.name == "episode")
    assert "states" not in texts


def test_joint_names_agree_with_the_hand() -> None:
    assert JOINT_NAMES[-len(MOTOR_NAMES) :] == MOTOR_NAMES
    assert len(JOINT_NAMES) == 18


def test_another_mcap_reader_can_read_it(tmp_path: Path, make_episode: MakeEpisode) -> None:
    """With nothing but the file: index, schemas, times and metadata, as Foxglove reads them."""
    view = View(
        boxes={"object": BoxLook((0.028, 0.1, 0.07), (0.8, 0.1, 0.1))},
        fixed_links={"root_link": np.array([0, 0, 0.15, 0.5**0.5, 0, 0, -(0.5**0.5)], np.float32)},
        focal_px=np.full((40, 2), 51.5, dtype=np.float32),
    )
    path = tmp_path / "episode.mcap"
    episode = make_episode(started_s=STARTED_S, view=view)
    write_episode(path, episode)
    seen: dict[str, list[Message]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            files = FileDescriptorSet.FromString(schema.data).file
            decoder = message_factory.GetMessages(list(files))[schema.name]
            step = message.sequence
            start_ns = round(STARTED_S * 1e9)
            assert message.log_time == start_ns + round(step * episode.control_period_s * 1e9)
            seen.setdefault(channel.topic, []).append(decoder.FromString(message.data))
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert {topic: messages[0].DESCRIPTOR.full_name for topic, messages in seen.items()} == {
        "/boxes": "foxglove.SceneUpdate",
        "/events": "foxglove.Log",
        "/eye": "foxglove.CompressedImage",
        "/eye/calibration": "foxglove.CameraCalibration",
        "/joints": "foxglove.JointStates",
        "/tf": "foxglove.FrameTransforms",
        "/step": "vmdnn.Step",
    }
    counts = {topic: len(messages) for topic, messages in seen.items()}
    assert counts.pop("/boxes") == 1
    assert counts.pop("/events") == len(episode.phase_names) + 1
    assert set(counts.values()) == {episode.steps}
    last_joints, last_step = seen["/joints"][-1], seen["/step"][-1]
    assert [joint.name for joint in last_joints.joints] == list(JOINT_NAMES)
    assert last_joints.joints[5].position == pytest.approx(np.radians(episode.joints_deg[-1, 5]))
    moved = np.radians(np.diff(episode.joints_deg[-2:, 5].astype(float))).item()
    velocity = moved / episode.control_period_s
    assert last_joints.joints[5].velocity == pytest.approx(velocity, rel=1e-5)
    assert last_step.action.r_elbow_deg == episode.actions[-1, 5]
    assert last_step.action.focus_level == episode.actions[-1, 10]
    frames = [(frame.parent_frame_id, frame.child_frame_id) for frame in seen["/tf"][7].transforms]
    assert frames == [
        ("world", "object"),
        ("world", "obstacle"),
        ("world", "root_link"),
        ("l_eye", "l_eye_optical"),
    ]
    assert seen["/eye"][0].frame_id == seen["/eye/calibration"][0].frame_id == "l_eye_optical"
    (box,) = seen["/boxes"][0].entities
    assert (box.frame_id, box.frame_locked, box.cubes[0].size.y) == ("object", True, 0.1)
    outcome = seen["/events"][-1]
    assert outcome.name == "outcome"
    assert outcome.message.startswith("lenient, strict; reason imprecise; ")
    assert "yaw_error_deg 11 deg" in outcome.message
    assert [event.message for event in seen["/events"][:2]] == list(episode.phase_names[:2])
    assert (last_step.phase, last_step.phase_name) == (8, "lift")
    assert metadata["outcome"]["reason"] == "imprecise"
    assert metadata["measures"]["yaw_error_deg"] == '[11.0, "deg"]'
    assert metadata["situation"] == {
        "obstacle_x_m": "-0.27",
        "object_y_m": "0.25",
        "object_yaw_deg": "-22.5",
    }
    assert metadata["episode"]["seed"] == "3001"
    assert metadata["episode"]["config_digest"] == "c0ffee"


@settings(max_examples=60)
@given(data=st.data())
def test_a_truncated_file_is_refused(
    data: st.DataObject, make_episode: MakeEpisode, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("cut") / "episode.mcap"
    write_episode(path, make_episode())
    whole = path.read_bytes()
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    with pytest.raises(UserError, match=rf"vmdnn recover {path}"):
        read_episode(path)


@settings(max_examples=150)
@given(data=st.data())
def test_a_flipped_byte_is_refused_or_harmless(
    data: st.DataObject, make_episode: MakeEpisode, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path, episode = tmp_path_factory.mktemp("flip") / "episode.mcap", make_episode(12)
    write_episode(path, episode)
    damaged = bytearray(path.read_bytes())
    damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(damaged)
    try:
        again = read_episode(path)
    except UserError:
        return
    for item in fields(Episode):
        assert same(getattr(again, item.name), getattr(episode, item.name)), item.name
    summary = read_summary(path)
    for item in fields(EpisodeSummary):
        assert same(getattr(summary, item.name), getattr(episode, item.name)), item.name


def test_other_files_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="No such file"):
        read_episode(tmp_path / "missing.mcap")
    text = tmp_path / "notes.mcap"
    text.write_text("this is no MCAP file, whatever its name says")
    with pytest.raises(UserError, match="not an MCAP file"):
        read_episode(text)
    foreign = tmp_path / "foreign.mcap"
    with foreign.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    with pytest.raises(UserError, match="no episode"):
        read_episode(foreign)


def test_an_episode_without_any_of_its_steps_is_refused(
    tmp_path: Path, make_episode: MakeEpisode
) -> None:
    """As another program may leave it that repairs MCAP files."""
    path = tmp_path / "episode.mcap"
    write_episode(path, make_episode(3))
    with path.open("rb") as stream:
        metadata = list(make_reader(stream).iter_metadata())
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for record in metadata:
            writer.add_metadata(record.name, record.metadata)
        writer.finish()
    for partial in (False, True):
        with pytest.raises(UserError, match="holds none of the 3 steps that were played"):
            read_episode(path, partial=partial)


def test_a_failed_write_keeps_the_old_file(tmp_path: Path, make_episode: MakeEpisode) -> None:
    path = tmp_path / "episode.mcap"
    write_episode(path, make_episode())
    before = path.read_bytes()
    broken = make_episode(joints_deg=make_episode().joints_deg[:, :5])
    with pytest.raises(ValueError, match="shorter"):
        write_episode(path, broken)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path, make_episode: MakeEpisode) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        write_episode(tmp_path / "file" / "episode.mcap", make_episode())


def test_a_file_of_format_1_can_be_read() -> None:
    episode = read_episode(DATA / "format1" / "episode.mcap")
    assert (episode.id, episode.kind, episode.policy_version) == ("0123456789abcdef", Kind.TRIAL, 3)
    assert list(episode.phases) == list(range(8))
    assert episode.phase_names[:2] == ("phase 1", "phase 2")
    outcome = episode.outcome
    assert (outcome.lenient, outcome.strict, outcome.precise) == (True, False, False)
    assert outcome.reason == "touched_obstacle"
    assert outcome.measures["moved_mm"] == Measure(1.0, "mm")
    assert outcome.measures["yaw_error_deg"] == Measure(11.0, "deg")
    assert outcome.measures["obstacle_touched_at"] == Measure(30.0, "step")


def ramp(*shape: int) -> np.ndarray:
    """Different numbers that float32 holds exactly, -16 to 16."""
    return (np.arange(np.prod(shape)).reshape(shape) % 1024 / 32 - 16).astype(np.float32)


def episode_of_format_2() -> Episode:
    """What `format2/episode.mcap` was written from, with vmdnn before format 3."""
    steps = 12
    pictures = np.arange(steps * IMAGE_HEIGHT * IMAGE_WIDTH) % 251
    return Episode(
        id="fedcba9876543210",
        kind=Kind.CORRECTION,
        task="experiment2",
        situation={"indicated_x_m": "-0.15", "object_y_m": 0.25},
        seed=2**62 + 1,
        actor="actor-1",
        backend="sapien",
        policy="network",
        policy_version=7,
        config_digest="c0ffee",
        images=pictures.reshape(steps, IMAGE_HEIGHT, IMAGE_WIDTH).astype(np.uint8),
        actions=ramp(steps, ACTION_SIZE),
        targets=-ramp(steps, ACTION_SIZE),
        joints_deg=5 * ramp(steps, len(JOINT_NAMES)),
        phase_names=("watch", "reach", "grasp"),
        phases=(np.arange(steps) // 4).astype(np.uint8),
        body_names=("object", "r_hand_dh_frame"),
        body_poses=ramp(steps, 2, 7) / 16,
        outcome=Outcome(True, False, False, "imprecise", {"yaw_error_deg": Measure(1 / 3, "deg")}),
        outputs=(ramp(steps, OUTPUTS) + 16) / 32,
        control_period_s=0.05,
        states={"pfc": ramp(steps, 3), "mstnn_fast": -ramp(steps, 5)},
        training="ab12",
    )


def test_a_file_of_format_2_is_read_as_it_was_written(tmp_path: Path) -> None:
    expected, path = episode_of_format_2(), tmp_path / "newest.mcap"
    read = read_episode(DATA / "format2" / "episode.mcap")
    write_episode(path, read)
    for episode in (read, read_episode(path)):
        for item in fields(Episode):
            assert same(getattr(episode, item.name), getattr(expected, item.name)), item.name
        assert (episode.started_s, episode.view) == (None, None)


def test_a_file_of_a_newer_format_is_refused(
    tmp_path: Path, make_episode: MakeEpisode, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "episode.mcap"
    with monkeypatch.context() as later:
        later.setattr("proto.recordings.episodes.FORMAT", 4)
        write_episode(path, make_episode(3))
    with pytest.raises(UserError, match=r"of format 4, written by a newer vmdnn.*update vmdnn"):
        read_episode(path)


def test_a_step_in_a_phase_without_a_name_is_refused(make_episode: MakeEpisode) -> None:
    with pytest.raises(ValueError, match="in phase 7 of 3"):
        make_episode(8, phase_names=("a", "b", "c"))
