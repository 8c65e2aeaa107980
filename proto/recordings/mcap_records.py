"""Reads the records of MCAP files that nobody vouches for.

Two readers: `whole_records` accepts a file only as it was written, `salvaged_records` finds every
whole record of a damaged one. Both limit what a file may become when it is unpacked: a compressed
chunk of 16 KB could take gigabytes, or hours.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from io import BytesIO
from typing import Any, Final, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Metadata,
    Schema,
)

MAGIC: Final = b"\x89MCAP0\r\n"
LARGEST_FILE: Final = 2**30
"""Size of a file that is read (bytes)."""

_FRAME: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
_FOOTER: Final = struct.Struct("<QQI")
_KINDS: Final[Mapping[int, Any]] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
    Opcode.DATA_END: DataEnd,
}
"""Kinds of records that are read; all others only index these."""
_LAST_KIND: Final = 0x0F
"""MCAP's own kinds of records end here; what others add is not kept when a file is damaged."""
_START_OF_A_RECORD: Final = re.compile(rb"[\x01-\x0f].{4}\x00{4}", re.DOTALL)
"""A kind of record, and a length below 4 GiB."""
_MOST_MESSAGES: Final = 40_000
_BYTES_PER_MESSAGE: Final = 32
_MOST_OTHERS: Final = 10_000
_BYTES_PER_OTHER: Final = 256
"""Of records that are neither messages nor chunks; there are a few in each file."""
_UNPACKED_BYTES: Final = 16 * 2**20
_UNPACKED_PER_BYTE: Final = 8
_LARGEST_CHUNK: Final = 16 * 2**20
_BROKEN: Final = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    LookupError,
    RuntimeError,  # raised by lz4
    OverflowError,
    MemoryError,
)
"""What reading damaged bytes raises."""


class DamageError(Exception):
    """A file, or a part of it, is damaged or cut off."""


class NotMcapError(DamageError):
    """A file does not begin as an MCAP file does."""


class TooMuchError(DamageError):
    """A file holds more, when it is unpacked, than any recording of its size."""


class _Frame(NamedTuple):
    """A record that is not read yet: its kind, and where its content begins and ends."""

    kind: int
    begin: int
    end: int


class _Limits:
    """How much a file may still become."""

    def __init__(self, size: int) -> None:
        self._messages = _MOST_MESSAGES + size // _BYTES_PER_MESSAGE
        self._others = _MOST_OTHERS + size // _BYTES_PER_OTHER
        self._bytes = _UNPACKED_BYTES + _UNPACKED_PER_BYTE * size

    @property
    def exhausted(self) -> bool:
        """Whether the file has become too large."""
        return min(self._messages, self._others, self._bytes) < 0

    def take_message(self) -> None:
        """Count a message, or another record."""
        self._messages -= 1
        if self._messages < 0:
            raise TooMuchError("it has more messages than any recording of its size")

    def take_other(self) -> None:
        """Count a record that is neither a message nor a chunk."""
        self._others -= 1
        if self._others < 0:
            raise TooMuchError("it has more records than any recording of its size")

    def take_bytes(self, count: int) -> None:
        """Count bytes that are unpacked or examined."""
        self._bytes -= count
        if self._bytes < 0:
            raise TooMuchError("it is larger, when it is unpacked, than any recording of its size")


def whole_records(content: bytes) -> Iterator[McapRecord]:
    """Yield the records of a file in order, those inside chunks too, without indices.

    Args:
        content: the file.

    Raises:
        NotMcapError: it is no MCAP file.
        TooMuchError: it becomes too large when it is unpacked.
        DamageError: it is damaged or cut off after the last record that was yielded.
    """
    if not content.startswith(MAGIC):
        raise NotMcapError("it does not begin as an MCAP file does")
    limits, at, kind = _Limits(len(content)), len(MAGIC), 0
    while kind != Opcode.FOOTER:
        frame = _frame(content, at)
        if frame is None:
            raise DamageError(f"the record at byte {at} is cut off")
        kind = frame.kind
        limits.take_message()
        if kind == Opcode.CHUNK:
            yield from _chunk_records(content, frame, limits)
        elif kind == Opcode.MESSAGE:
            yield _message(content, frame.begin, frame.end)
        elif kind in _KINDS:
            limits.take_other()
            record = _record(content, frame)
            _check_sums(content, at, record)
            yield record
        at = frame.end
    if content[at : at + len(MAGIC)] != MAGIC:
        raise DamageError("its end is damaged")


def salvaged_records(content: bytes) -> list[McapRecord]:
    """Return each whole record of a damaged file, in the order of the file.

    Chunks must have the content that their checksum tells. Schemas and channels of the summary at
    the end are returned too, because those in a damaged chunk are lost.

    Args:
        content: the file.

    Raises:
        TooMuchError: it becomes too large when it is unpacked.
    """
    limits, at = _Limits(len(content)), 0
    if content.startswith(MAGIC):
        at = len(MAGIC)
    in_chunks: list[McapRecord] = []
    outside: list[McapRecord] = []
    merged: list[McapRecord] = []
    while at < len(content):
        frame = _frame(content, at)
        if frame is not None and frame.kind > _LAST_KIND:
            frame = None
        records = None if frame is None else _salvage(content, frame, limits)
        if frame is None or records is None:
            found = _START_OF_A_RECORD.search(content, at + 1)
            at = len(content) if found is None else found.start()
            continue
        (in_chunks if frame.kind == Opcode.CHUNK else outside).extend(records)
        merged += records
        at = frame.end
    if not in_chunks:
        return merged
    # A message outside of a chunk has no checksum. In a file with chunks it is a record of another
    # kind whose kind is damaged.
    wrong = {id(record) for record in outside if isinstance(record, Message)}
    return [record for record in merged if id(record) not in wrong]


def _salvage(content: bytes, frame: _Frame, limits: _Limits) -> list[McapRecord] | None:
    """The records of a frame, empty for an index; None if it is none, or damaged."""
    try:
        if frame.kind == Opcode.CHUNK:
            return list(_chunk_records(content, frame, limits))
        limits.take_message()
        if frame.kind == Opcode.MESSAGE:
            return [_message(content, frame.begin, frame.end)]
        if frame.kind in _KINDS:
            limits.take_other()
            limits.take_bytes(frame.end - frame.begin)
            record = _record(content, frame)
            return [record] if _is_as_written(record, content, frame) else None
    except DamageError:
        if limits.exhausted:
            raise
        return None
    following = _frame(content, frame.end)
    if following is None:
        return [] if content[frame.end :].startswith(MAGIC) else None
    return [] if following.kind <= _LAST_KIND else None


def _is_as_written(record: McapRecord, content: bytes, frame: _Frame) -> bool:
    """Whether a record has no byte too many or too few."""
    builder = RecordBuilder()
    record.write(builder)
    written = bytes(builder.end())  # type: ignore[no-untyped-call]
    found = content[frame.begin - _FRAME.size : frame.end]
    if isinstance(record, Attachment) and found[-4:] == bytes(4):  # without a checksum
        return written[:-4] == found[:-4]
    return written == found


def _frame(content: bytes, at: int) -> _Frame | None:
    """The record at some place; None if it is not there as a whole."""
    begin = at + _FRAME.size
    if begin > len(content):
        return None
    kind, length = _FRAME.unpack_from(content, at)
    if kind == 0 or length > len(content) - begin:
        return None
    return _Frame(kind, begin, begin + length)


def _record(content: bytes, frame: _Frame) -> McapRecord:
    """Read a record that is neither a chunk nor a message.

    Raises:
        DamageError: it is damaged.
    """
    stream = ReadDataStream(BytesIO(content[frame.begin : frame.end]))
    try:
        record: McapRecord = _KINDS[frame.kind].read(stream)
    except _BROKEN as error:
        raise DamageError(f"the record at byte {frame.begin} is damaged") from error
    return record


def _message(content: bytes, begin: int, end: int) -> Message:
    if end - begin < _MESSAGE.size:
        raise DamageError("a message is too short")
    channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(content, begin)
    return Message(
        channel_id=channel,
        log_time=log_time,
        data=content[begin + _MESSAGE.size : end],
        publish_time=publish_time,
        sequence=sequence,
    )


def _chunk_records(content: bytes, frame: _Frame, limits: _Limits) -> Iterator[McapRecord]:
    """Yield the records in a chunk; nothing if the chunk is damaged.

    Raises:
        TooMuchError: it becomes too large.
        DamageError: it is damaged.
    """
    chunk = _record(content, frame)
    assert isinstance(chunk, Chunk)
    # 40 bytes besides: times, sizes, checksum, and the lengths of compression and data.
    if 40 + len(chunk.compression.encode()) + len(chunk.data) != frame.end - frame.begin:
        raise DamageError("a chunk has another length than it says")
    data = _unpacked(chunk, limits)
    at = 0
    while at < len(data):
        inner = _frame(data, at)
        if inner is None:
            raise DamageError("a record in a chunk is cut off")
        limits.take_message()
        if inner.kind == Opcode.MESSAGE:
            yield _message(data, inner.begin, inner.end)
        elif inner.kind in (Opcode.SCHEMA, Opcode.CHANNEL):
            limits.take_other()
            yield _record(data, inner)
        at = inner.end


def _unpacked(chunk: Chunk, limits: _Limits) -> bytes:
    """The content of a chunk.

    Raises:
        TooMuchError: it is too large.
        DamageError: it is damaged.
    """
    size = chunk.uncompressed_size
    try:
        if _told_size(chunk) not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise DamageError("the sizes of a chunk contradict each other")
        if size > max(_LARGEST_CHUNK, len(chunk.data)):
            raise TooMuchError(f"a chunk has {size} bytes when it is unpacked")
        limits.take_bytes(size)
        data = _decompressed(chunk)
    except _BROKEN as error:
        raise DamageError("a chunk is damaged") from error
    if len(data) != size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        raise DamageError("a chunk differs from its checksum")
    return data


def _told_size(chunk: Chunk) -> int:
    """Size of the unpacked content as the packed one tells it."""
    if chunk.compression == "":
        return len(chunk.data)
    if chunk.compression == "zstd":
        return int(zstandard.get_frame_parameters(chunk.data).content_size)
    return int(zstandard.CONTENTSIZE_UNKNOWN)


def _decompressed(chunk: Chunk) -> bytes:
    size = chunk.uncompressed_size
    if size == 0 or chunk.compression == "":
        return chunk.data[:size]
    if chunk.compression == "zstd":
        return bytes(zstandard.decompress(chunk.data, size))
    if chunk.compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size))
    raise ValueError("its compression is not known")


def _check_sums(content: bytes, at: int, record: McapRecord) -> None:
    """Compare checksums of data and summary, where the record has one.

    Raises:
        DamageError: they differ.
    """
    if isinstance(record, DataEnd):
        told, covered = record.data_section_crc, memoryview(content)[:at]
    elif isinstance(record, Footer):
        end = at + _FRAME.size + _FOOTER.size - 4  # all of the footer but the checksum itself
        told, covered = record.summary_crc, memoryview(content)[record.summary_start or at : end]
    else:
        return
    if told and zlib.crc32(covered) != told:
        raise DamageError("it differs from its checksum")
