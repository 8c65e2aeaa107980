"""Recovery of the whole records of a damaged MCAP file."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.records import (
    Attachment,
    Channel,
    DataEnd,
    Header,
    McapRecord,
    Message,
    Metadata,
    Schema,
)
from mcap.writer import Writer

from proto.errors import UserError
from proto.reading import read_limited
from proto.recordings.episodes import CHUNK_BYTES, STEP
from proto.recordings.mcap_records import (
    LARGEST_FILE,
    MAGIC,
    DamageError,
    TooMuchError,
    salvaged_records,
    whole_records,
)
from proto.storage import written_whole


@dataclass(frozen=True)
class Recovered:
    """Result of a recovery.

    Attributes:
        intact: the file was complete, so there was nothing to recover.
        messages: number of whole messages.
        steps: number of complete control steps of the episode.
        steps_played: number of control steps that were played; None if the file is not an episode.
    """

    intact: bool
    messages: int
    steps: int
    steps_played: int | None


def recover(path: Path, out: Path | None = None) -> Recovered:
    """Write an MCAP file with all whole records of another one, wherever that is damaged.

    Only the messages of a damaged chunk are lost. A message whose channel is nowhere described is
    kept in a channel `lost/NUMBER`.

    Args:
        path: any MCAP file. It is not changed, unless it is also `out`.
        out: the file to write; None replaces `path`, unless `path` is intact.

    Raises:
        UserError: `path` cannot be read, is not MCAP, has no whole message or is an episode without
            any complete step, or `out` cannot be written.
    """
    kept, intact = _records(path)
    found = _count(kept, intact)
    if not found.messages:
        raise UserError(f"{path} has no complete message, so nothing can be recovered")
    if found.steps_played and not found.steps:
        raise UserError(
            f"{path} has no complete step of {found.steps_played}, so nothing can be recovered"
        )
    in_place = out is None or out.resolve() == path.resolve()
    if not (intact and in_place):
        try:
            with written_whole(out or path) as stream:
                _write(kept, stream)
        except struct.error as error:
            raise UserError(f"{path} has more channels or schemas than MCAP can hold") from error
    return found


def _records(path: Path) -> tuple[list[McapRecord], bool]:
    """The whole records of a file, and whether it is undamaged."""
    try:
        content = read_limited(path, LARGEST_FILE)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    try:
        return list(whole_records(content)), True
    except DamageError:
        pass
    try:
        kept = salvaged_records(content)
    except TooMuchError as error:
        raise UserError(f"{path} is not recovered: {error}") from error
    if not kept and not content.startswith(MAGIC):
        raise UserError(f"{path} is not an MCAP file")
    return kept, False


def _count(kept: Sequence[McapRecord], intact: bool) -> Recovered:
    topics: dict[int, str] = {}
    for record in kept:
        if isinstance(record, Channel):
            topics.setdefault(record.id, record.topic)  # the first counts, see `_register`
    messages = [record for record in kept if isinstance(record, Message)]
    played = [
        int(record.metadata["steps"])
        for record in kept
        if isinstance(record, Metadata)
        and record.name == "episode"
        and record.metadata.get("steps", "")[:10].isdecimal()
        and len(record.metadata["steps"]) < 10
    ]
    return Recovered(
        intact=intact,
        messages=len(messages),
        steps=sum(topics.get(message.channel_id) == STEP for message in messages),
        steps_played=played[0] if played else None,
    )


def _write(kept: Sequence[McapRecord], stream: BinaryIO) -> None:
    writer = Writer(stream, chunk_size=CHUNK_BYTES, enable_data_crcs=True)
    header = next((record for record in kept if isinstance(record, Header)), Header("", ""))
    writer.start(header.profile, header.library)
    for record in _data_of(kept):
        if isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
    channels = _register(kept, writer)
    for record in kept:
        if isinstance(record, Message):
            if record.channel_id not in channels:
                lost = f"lost/{record.channel_id}"
                channels[record.channel_id] = writer.register_channel(lost, "", 0)
            writer.add_message(
                channels[record.channel_id],
                record.log_time,
                record.data,
                record.publish_time,
                record.sequence,
            )
    writer.finish()  # type: ignore[no-untyped-call]


def _data_of(kept: Sequence[McapRecord]) -> Sequence[McapRecord]:
    """The records before the end of the data; what follows repeats and indexes them."""
    ends = [number for number, record in enumerate(kept) if isinstance(record, DataEnd)]
    return kept[: ends[0]] if ends else kept


def _register(kept: Sequence[McapRecord], writer: Writer) -> dict[int, int]:
    """Describe schemas and channels; the number of each channel in the new file by the old one.

    The first description of a number counts: in a chunk it has a checksum, in the summary not.
    """
    schemas, channels = {0: 0}, {}
    for record in kept:
        if isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
    for record in kept:
        if isinstance(record, Channel) and record.id not in channels:
            channels[record.id] = writer.register_channel(
                record.topic,
                record.message_encoding,
                schemas.get(record.schema_id, 0),
                record.metadata,
            )
    return channels
