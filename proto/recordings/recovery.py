"""Recovery of the complete records of a truncated MCAP file."""

from __future__ import annotations

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
from proto.recordings.episodes import CHUNK_BYTES, DAMAGE, STEP, records
from proto.storage import written_whole


@dataclass(frozen=True)
class Recovered:
    """Result of a recovery.

    Attributes:
        intact: the file was complete, so there was nothing to recover.
        messages: number of complete messages.
        steps: number of complete control steps of the episode.
        steps_played: number of control steps that were played; None if the file is not an episode.
    """

    intact: bool
    messages: int
    steps: int
    steps_played: int | None


def recover(path: Path, out: Path | None = None) -> Recovered:
    """Write an MCAP file with all complete records of another one.

    Args:
        path: any MCAP file. It is not changed, unless it is also `out`.
        out: the file to write; None replaces `path`, unless `path` is intact.

    Raises:
        UserError: `path` cannot be read, is not MCAP, has no complete message or is an episode cut
            off before its first step was complete, or `out` cannot be written.
    """
    kept, intact = _whole_records(path)
    found = _count(kept, intact)
    if not found.messages:
        raise UserError(f"{path} has no complete message, so nothing can be recovered")
    if found.steps_played and not found.steps:
        raise UserError(
            f"{path} has no complete step of {found.steps_played}, so nothing can be recovered"
        )
    in_place = out is None or out.resolve() == path.resolve()
    if not (intact and in_place):
        with written_whole(out or path) as stream:
            _write(kept, stream)
    return found


def _whole_records(path: Path) -> tuple[list[McapRecord], bool]:
    """Return the data records before the first damage, and whether there is no damage."""
    kept: list[McapRecord] = []
    in_data = True  # the records after the data section only repeat and index it
    try:
        for record in records(path):
            in_data = in_data and not isinstance(record, DataEnd)
            if in_data:
                kept.append(record)
    except DAMAGE:
        return kept, False
    return kept, True


def _count(kept: Sequence[McapRecord], intact: bool) -> Recovered:
    step_channels = {
        record.id for record in kept if isinstance(record, Channel) and record.topic == STEP
    }
    messages = [record for record in kept if isinstance(record, Message)]
    played = [
        int(record.metadata["steps"])
        for record in kept
        if isinstance(record, Metadata)
        and record.name == "episode"
        and record.metadata.get("steps", "").isdecimal()
    ]
    return Recovered(
        intact=intact,
        messages=len(messages),
        steps=sum(message.channel_id in step_channels for message in messages),
        steps_played=played[0] if played else None,
    )


def _write(kept: Sequence[McapRecord], stream: BinaryIO) -> None:
    writer = Writer(stream, chunk_size=CHUNK_BYTES, enable_data_crcs=True)
    header = next((record for record in kept if isinstance(record, Header)), Header("", ""))
    writer.start(header.profile, header.library)
    schemas, channels = {0: 0}, {}
    for record in kept:
        if isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels:
            channels[record.id] = writer.register_channel(
                record.topic,
                record.message_encoding,
                schemas[record.schema_id],
                record.metadata,
            )
        elif isinstance(record, Message):
            writer.add_message(
                channels[record.channel_id],
                record.log_time,
                record.data,
                record.publish_time,
                record.sequence,
            )
    writer.finish()  # type: ignore[no-untyped-call]
