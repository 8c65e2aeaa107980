"""Recovery restores the complete records of a truncated file and never loses a file."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer
from processes import eventually

from proto.episode import BoxLook, Episode, View
from proto.errors import UserError
from proto.recordings.episodes import STEP, read_episode, write_episode
from proto.recordings.recovery import recover
from services.cli import main
from services.robot_meshes import robot_meshes

MakeEpisode = Callable[..., Episode]

STEPS = 125


@pytest.fixture(scope="module")
def episode(make_episode: MakeEpisode) -> Episode:
    """An episode with every optional field."""
    random = np.random.default_rng(0)
    view = View(
        boxes={"object": BoxLook((0.028, 0.1, 0.07), (0.8, 0.1, 0.1))},
        fixed_links={"root_link": np.array([0, 0, 0.15, 1, 0, 0, 0], np.float32)},
        focal_px=random.uniform(50, 900, (STEPS, 2)).astype(np.float32),
    )
    states = {"pfc": random.random((STEPS, 20), dtype=np.float32)}
    return make_episode(STEPS, started_s=1_700_000_000.25, view=view, states=states)


@pytest.fixture(scope="module")
def recording(episode: Episode, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of a whole recording."""
    path = tmp_path_factory.mktemp("whole") / "episode.mcap"
    write_episode(path, episode, robot=robot_meshes())
    return path.read_bytes()


@pytest.fixture(scope="module")
def chunks(recording: bytes) -> list[tuple[int, int]]:
    """For each chunk of the recording: where it ends, and how many steps are complete by then."""
    stream = BytesIO(recording)
    ends, steps, channel = [], 0, None
    for chunk in StreamReader(stream, emit_chunks=True).records:
        if isinstance(chunk, Chunk):
            for record in breakup_chunk(chunk):
                if isinstance(record, Channel) and record.topic == STEP:
                    channel = record.id
                steps += isinstance(record, Message) and record.channel_id == channel
            ends.append((stream.tell(), steps))
    return ends


def assert_is_start_of(part: Episode, whole: Episode) -> None:
    for name in ("id", "outcome", "situation", "started_s"):
        assert getattr(part, name) == getattr(whole, name), name
    for name in ("images", "actions", "targets", "joints_deg", "phases", "body_poses", "outputs"):
        assert np.array_equal(getattr(part, name), getattr(whole, name)[: part.steps]), name
    assert part.states is not None
    assert whole.states is not None
    assert part.states.keys() == whole.states.keys()
    for name, activity in whole.states.items():
        assert np.array_equal(part.states[name], activity[: part.steps]), name
    assert part.view is not None
    assert whole.view is not None
    assert part.view.boxes == whole.view.boxes
    assert part.view.fixed_links.keys() == whole.view.fixed_links.keys()
    for name, pose in whole.view.fixed_links.items():
        assert np.array_equal(part.view.fixed_links[name], pose), name
    assert np.array_equal(part.view.focal_px, whole.view.focal_px[: part.steps])


@settings(max_examples=60)
@given(data=st.data())
def test_a_truncated_file_keeps_the_steps_of_every_complete_chunk(
    data: st.DataObject,
    recording: bytes,
    chunks: list[tuple[int, int]],
    episode: Episode,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    path = tmp_path_factory.mktemp("cut") / "episode.mcap"
    near_an_end = st.sampled_from(chunks).flatmap(
        lambda chunk: st.integers(chunk[0] - 2, min(chunk[0] + 2, len(recording) - 1))
    )
    size = data.draw(st.integers(0, len(recording) - 1) | near_an_end)
    path.write_bytes(recording[:size])
    complete = max((steps for end, steps in chunks if end <= size), default=0)
    if complete == 0:
        with pytest.raises(UserError, match=r"no complete (step|message)|is not an MCAP file"):
            recover(path)
        assert path.read_bytes() == recording[:size]
        return
    found = recover(path)
    part = read_episode(path, partial=True)
    assert_is_start_of(part, episode)
    assert not found.intact
    assert (part.steps, found.steps, found.steps_played) == (complete, complete, STEPS)
    assert recover(path).intact


@dataclass(frozen=True)
class Layout:
    """Where the chunks of a recording are.

    Attributes:
        spans: first byte and end of each chunk's record.
        steps: number of steps that are complete in each.
        messages: number of messages in each.
    """

    spans: list[tuple[int, int]]
    steps: list[int]
    messages: list[int]


@pytest.fixture(scope="module")
def layout(recording: bytes) -> Layout:
    stream = BytesIO(recording)
    found, channel = Layout([], [], []), None
    for chunk in StreamReader(stream, emit_chunks=True).records:
        if isinstance(chunk, Chunk):
            size = 9 + 8 + 8 + 8 + 4 + 4 + len(chunk.compression) + 8 + len(chunk.data)
            found.spans.append((stream.tell() - size, stream.tell()))
            records = breakup_chunk(chunk)
            for record in records:
                if isinstance(record, Channel) and record.topic == STEP:
                    channel = record.id
            messages = [record for record in records if isinstance(record, Message)]
            found.messages.append(len(messages))
            found.steps.append(sum(message.channel_id == channel for message in messages))
    return found


def flips(recording: bytes, layout: Layout, count: int) -> list[int]:
    """Bits to flip: some anywhere, most in what is small: frames, sizes, checksums, magic."""
    random = np.random.default_rng(7)
    ends = [at for span in layout.spans for at in span]
    near = [at + offset for at in ends for offset in range(-9, 60)]
    near += [*range(400), *range(len(recording) - 3000, len(recording))]
    near = sorted({at for at in near if 0 <= at < len(recording)})
    places = [*random.choice(near, count * 3 // 4), *random.integers(0, len(recording), count // 4)]
    return [int(at) * 8 + int(random.integers(8)) for at in places]


def flips_of_the_step_channel(recording: bytes) -> list[int]:
    """Bits of the channel's number in the summary, which repeats the channels of the chunks."""
    kind, size, number, schema, length = 1, 8, 2, 2, 4  # bytes of what precedes the topic
    record = recording.rindex(STEP.encode()) - (kind + size + number + schema + length)
    assert recording[record] == Opcode.CHANNEL
    first = 8 * (record + kind + size)
    return list(range(first, first + 8 * number))


def check_flip(bit: int, recording: bytes, layout: Layout, folder: Path) -> None:
    """A file with one flipped bit keeps all messages but those of the chunk that has the bit."""
    at = bit // 8
    damaged = bytearray(recording)
    damaged[at] ^= 1 << bit % 8
    path = folder / "flipped.mcap"
    path.write_bytes(damaged)
    found = recover(path, folder / "out.mcap")
    lost = [begin <= at < end for begin, end in layout.spans]
    kept = [not each for each in lost]
    all_of_it = (sum(layout.messages), sum(layout.steps))  # the bit is in the times of a chunk
    all_but_one = (sum(np.array(layout.messages)[kept]), sum(np.array(layout.steps)[kept]))
    assert (found.messages, found.steps) in (all_of_it, all_but_one), f"bit {bit}"
    assert recover(folder / "out.mcap").intact


def test_one_flipped_bit_costs_at_most_the_chunk_that_has_it(
    recording: bytes, layout: Layout, tmp_path: Path
) -> None:
    length_of_an_index = 8 * (layout.spans[0][1] + 1)  # it may swallow what begins the next chunk
    first = range(length_of_an_index, length_of_an_index + 16)
    for bit in (*flips(recording, layout, 100), *flips_of_the_step_channel(recording), *first):
        check_flip(bit, recording, layout, tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_each_of_many_flipped_bits_costs_at_most_the_chunk_that_has_it(
    recording: bytes, layout: Layout, tmp_path: Path
) -> None:
    for bit in flips(recording, layout, 20_000):
        check_flip(bit, recording, layout, tmp_path)


def foreign_file(chunked: bool) -> bytes:
    """An MCAP file of another program: schemas, channels, metadata and an attachment of its own."""
    stream = BytesIO()
    writer = Writer(stream, chunk_size=200, use_chunking=chunked)
    writer.start("ros2", "another")
    writer.add_attachment(1, 2, "notes.txt", "text/plain", b"hello")
    writer.add_metadata("theirs", {"a": "b"})
    for number in range(4):
        schema = writer.register_schema(f"pkg/Type{number}", "ros2msg", b"float64 x")
        writer.register_channel(f"/topic{number}", "cdr", schema, {"qos": "1"})
    for number in range(80):
        channel = number % 4 + 1
        writer.add_message(channel, number, b"content %d" % number, number, number)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def content_of(path: Path) -> list[tuple[str, str, bytes]]:
    with path.open("rb") as stream:
        return [
            (channel.topic, schema.name if schema else "", message.data)
            for schema, channel, message in make_reader(stream).iter_messages()
        ]


@pytest.mark.parametrize("chunked", [True, False])
def test_files_of_other_programs_are_recovered_too(tmp_path: Path, chunked: bool) -> None:
    whole, path, out = foreign_file(chunked), tmp_path / "file.mcap", tmp_path / "out.mcap"
    path.write_bytes(whole)
    expected = content_of(path)
    assert len(expected) == 80
    assert recover(path, out).intact
    assert content_of(out) == expected
    kept = []
    contents = [data for _, _, data in expected]
    for at in range(0, len(whole), 41):
        damaged = bytearray(whole)
        damaged[at] ^= 0x10
        path.write_bytes(damaged)
        recover(path, out)
        found = content_of(out)
        # Outside of chunks nothing tells that a name or a content is another one.
        right = [
            each for each in found if each in expected or (not chunked and each[2] in contents)
        ]
        assert len(right) >= (80 - 12 if chunked else 80 - 2), f"byte {at}: {len(right)} are kept"
        kept.append(len(found))
    assert max(kept) == 80


def test_messages_of_a_channel_that_is_lost_are_kept(tmp_path: Path) -> None:
    """Its description is in a damaged chunk, and the file has no summary."""
    whole, path = foreign_file(chunked=True), tmp_path / "file.mcap"
    damaged = bytearray(whole[: whole.index(b"\x0f" + (4).to_bytes(8, "little"))])
    damaged[whole.index(b"zstd") + 30] ^= 1
    path.write_bytes(damaged)
    recover(path)
    topics = {topic for topic, _, _ in content_of(path)}
    assert topics & {"lost/1", "lost/2", "lost/3", "lost/4"}


def test_a_chunk_holds_few_steps(chunks: list[tuple[int, int]]) -> None:
    """As many are lost if the process is killed; what viewers need once is in no chunk of steps."""
    steps = np.diff([0, *(steps for _, steps in chunks)])
    assert steps[0] == 0
    assert steps.max() <= 15


def test_a_process_killed_while_recording_leaves_a_recoverable_file(
    recording: bytes, episode: Episode, tmp_path: Path
) -> None:
    """The other process would need many seconds to write it all; it is killed long before."""
    source, target = tmp_path / "short.mcap", tmp_path / "long.mcap"
    script = f"""
from dataclasses import replace
from pathlib import Path
import numpy as np
from proto.recordings.episodes import read_episode, write_episode
episode = read_episode(Path({str(source)!r}))
arrays = {{
    name: np.concatenate([getattr(episode, name)] * 500)
    for name in ("images", "actions", "targets", "joints_deg", "phases", "body_poses", "outputs")
}}
write_episode(Path({str(target)!r}), replace(episode, view=None, states=None, **arrays))
"""
    source.write_bytes(recording)
    process = subprocess.Popen([sys.executable, "-c", script])
    try:
        part = _wait_for_part(target, process, size=300_000)
    finally:
        process.kill()
        process.wait()
    assert not target.exists()
    with pytest.raises(UserError, match="vmdnn recover"):
        read_episode(part)
    cut_off = part.read_bytes()
    assert main(["recover", str(part), "--out", str(target)]) == 0
    assert part.read_bytes() == cut_off
    recovered = read_episode(target, partial=True)
    assert recovered.steps > 10
    repeats = -(-recovered.steps // episode.steps)
    expected = np.concatenate([episode.actions] * repeats)[: recovered.steps]
    assert np.array_equal(recovered.actions, expected)


def _wait_for_part(target: Path, process: subprocess.Popen[bytes], size: int) -> Path:
    def long_enough() -> list[Path]:
        assert process.poll() is None, "the other process ended too early"
        parts = target.parent.glob(f"{target.name}.*.part")
        return [part for part in parts if part.stat().st_size > size]

    eventually(lambda: bool(long_enough()), "the other process has written enough")
    return long_enough()[0]


def test_a_recovered_episode_is_not_read_as_a_complete_one(
    recording: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "episode.mcap"
    path.write_bytes(recording[: len(recording) // 2])
    assert main(["recover", str(path)]) == 0
    with pytest.raises(UserError, match=rf"of {STEPS} steps, recovered from a file that was cut"):
        read_episode(path)


def test_an_intact_file_is_left_alone(
    recording: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, copy = tmp_path / "episode.mcap", tmp_path / "copy.mcap"
    path.write_bytes(recording)
    before = path.stat()
    assert main(["recover", str(path)]) == 0
    told = capsys.readouterr().out
    assert re.search(rf"is whole \(\d+ messages, {STEPS} of {STEPS} steps\)", told)
    assert path.stat().st_mtime_ns == before.st_mtime_ns
    assert main(["recover", str(path), "--out", str(copy)]) == 0
    assert read_episode(copy).id == read_episode(path).id


def test_a_recovery_that_cannot_be_written_changes_nothing(
    recording: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, blocked = tmp_path / "episode.mcap", tmp_path / "folder"
    path.write_bytes(recording[:-100])
    blocked.mkdir()
    assert main(["recover", str(path), "--out", str(blocked)]) == 2
    assert "cannot be written" in capsys.readouterr().err
    assert path.read_bytes() == recording[:-100]
    assert sorted(tmp_path.iterdir()) == [path, blocked]


@pytest.mark.parametrize("content", [b"", b"not an MCAP file at all"])
def test_a_file_without_complete_messages_is_refused(
    content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "episode.mcap"
    path.write_bytes(content)
    assert main(["recover", str(path)]) == 2
    assert str(path) in capsys.readouterr().err
    assert path.read_bytes() == content
