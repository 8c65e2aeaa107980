"""Hostile inputs by name, each at most 1 MiB, and what reads them.

Run as a program, it reads each of them in a process of its own and prints what that cost, as JSON.
"""

from __future__ import annotations

import ctypes
import gc
import io
import json
import os
import resource
import struct
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import msgpack
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zstandard
from decoders import DECODERS, MESSAGES, Decoder, small_episode, small_policy, wire_input
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, Message, Metadata, Schema

from proto.codec import encode
from proto.messages import Live, PolicyVersion, Rollout, Settings
from proto.metrics import EvaluatorMetrics
from proto.recordings.mcap_records import MAGIC
from proto.recordings.schemas import CompressedImage

MIB = 2**20
Case = tuple[str, str, Callable[[], bytes]]
"""Decoder, what the input is, and what makes it."""


def _filled(begin: bytes, piece: bytes, end: bytes = b"") -> bytes:
    """Pieces up to 1 MiB."""
    return begin + piece * ((MIB - len(begin) - len(end)) // len(piece)) + end


def _msgpack_array(piece: bytes) -> bytes:
    count = MIB // len(piece) - 8
    return b"\x81\xa7episode\xdd" + struct.pack(">I", count) + piece * count


def _nested_arrays() -> bytes:
    """Small arrays in arrays in arrays, with empty maps inside."""
    inner = b"\xdc\x01\x00" + b"\x80" * 256
    return _msgpack_array(inner)


def _odd_field(value: object) -> bytes:
    content = msgpack.unpackb(encode(Rollout(small_episode(1), "ab12")).payload)
    content["episode"]["images"] = ["uint8", value, b""]
    return wire_input(Rollout, msgpack.packb(content))


def _nested(depth: int) -> object:
    value: object = []
    for _ in range(depth):
        value = [value]
    return value


def _safetensors(header: bytes, claimed: int | None = None) -> bytes:
    return struct.pack("<Q", len(header) if claimed is None else claimed) + header


def _metadata(text: str) -> bytes:
    return _safetensors(json.dumps({"__metadata__": {"vmdnn": text}}).encode())


def _policy_metadata(change: Callable[[dict], object]) -> bytes:
    blob = small_policy().weights
    size = int.from_bytes(blob[:8], "little")
    header = json.loads(blob[8 : 8 + size])
    values = json.loads(header["__metadata__"]["vmdnn"])
    change(values)
    header["__metadata__"]["vmdnn"] = json.dumps(values)
    return _safetensors(json.dumps(header).encode()) + blob[8 + size :]


def _frame(record: object) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def _chunk(data: bytes, size: int | None = None) -> bytes:
    packed = zstandard.ZstdCompressor(level=3).compress(data)
    return _frame(
        Chunk(
            compression="zstd",
            data=packed,
            message_start_time=0,
            message_end_time=0,
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data) if size is None else size,
        )
    )


def _message(data: bytes, channel: int = 1) -> bytes:
    return _frame(Message(channel, 0, data, 0, 0))


def _episode_texts(**given: str) -> dict[str, str]:
    texts = {
        "format": "3", "id": "a", "kind": "trial", "task": "t", "seed": "1", "actor": "a",
        "backend": "b", "policy": "p", "policy_version": "1", "training": "", "config_digest": "",
        "control_period_s": "0.1", "steps": "1", "phase_names": '["x"]', "outputs": "null",
        "body_names": "[]",
    }  # fmt: skip
    return texts | given


def _mcap(chunks: bytes, *, metadata: bytes | None = None, **given: str) -> bytes:
    outcome = {"lenient": "false", "strict": "false", "precise": "false", "reason": "x_y"}
    told = metadata or b"".join(
        _frame(Metadata(name, texts))
        for name, texts in (
            ("episode", _episode_texts(**given)),
            ("situation", {}),
            ("outcome", outcome),
            ("measures", {}),
        )
    )
    end = b"\x0f" + struct.pack("<QI", 4, 0) + b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0)
    return MAGIC + _frame(Header("", "")) + told + chunks + end + MAGIC


def _topics(*topics: str) -> bytes:
    channels = (
        _frame(Channel(number, topic, "protobuf", {}, 0)) for number, topic in enumerate(topics, 1)
    )
    return b"".join(channels)


def _zeros_of(gib: float) -> bytes:
    """A chunk with an unknown channel's messages of zeros, some GiB in a few kilobytes."""
    compressor = zstandard.ZstdCompressor().compressobj(size=int(gib * 2**30))
    packed = b"".join(compressor.compress(bytes(2**24)) for _ in range(int(gib * 64)))
    packed += compressor.flush()
    chunk = Chunk("zstd", packed, 0, 0, 0, int(gib * 2**30))
    return _mcap(_frame(chunk))


def _png(width: int, height: int) -> bytes:
    def part(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    size = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = zlib.compressobj(9)
    packed = b"".join(rows.compress(bytes(width + 1)) for _ in range(height))
    data = part(b"IDAT", packed + rows.flush())
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", size) + data + part(b"IEND", b"")


def _picture(png: bytes) -> bytes:
    eye = CompressedImage(format="png", data=png).SerializeToString()
    return _mcap(_chunk(_topics("/eye", "/step") + _message(eye, 1) + _message(b"", 2)))


def _many_chunks(data: bytes) -> bytes:
    chunk = _chunk(data)
    return _mcap(chunk * (MIB // len(chunk) - 1))


def _overlapping_chunks() -> bytes:
    """Each chunk begins inside the one before, and reaches to the end; no checksum is right."""
    head = 9 + 40
    content = bytearray(MIB)
    for at in range(0, MIB - 2 * head, head):
        length = MIB - at - 9
        data = length - 40
        frame = struct.pack("<BQQQQIIQ", Opcode.CHUNK, length, 0, 0, data, 1, 0, data)
        content[at : at + head] = frame
    return bytes(content)


def _npy(header: bytes, content: bytes = b"") -> bytes:
    return b"\x93NUMPY\x02\x00" + struct.pack("<I", len(header)) + header + content


def _parquet_of(rows: int) -> bytes:
    content = io.BytesIO()
    column = pa.DictionaryArray.from_arrays(
        pa.array(np.zeros(rows, np.int32)), pa.array([0.5], pa.float64())
    )
    table = pa.table({"episode_index": column, "action": column})
    pq.write_table(table, content, compression="zstd")
    return content.getvalue()


LAUGHS = b"a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + b"".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n".encode() for n in range(1, 9)
)


def cases() -> Iterator[Case]:
    """All hostile inputs."""
    rollout, metrics, settings = Rollout, EvaluatorMetrics, Settings
    yield (
        "messages",
        "empty maps by the million",
        lambda: wire_input(rollout, _msgpack_array(b"\x80")),
    )
    yield "messages", "empty maps in small arrays", lambda: wire_input(rollout, _nested_arrays())
    yield (
        "messages",
        "short texts by the 100,000",
        lambda: wire_input(rollout, _msgpack_array(b"\xa2ab")),
    )
    yield (
        "messages",
        "maps of one key",
        lambda: wire_input(rollout, _msgpack_array(b"\x81\xa0\xc0")),
    )
    yield (
        "messages",
        "1,000 arrays inside each other",
        lambda: wire_input(rollout, b"\x91" * 1000 + b"\xc0"),
    )
    yield (
        "messages",
        "1,000,000 arrays inside each other",
        lambda: wire_input(rollout, b"\x91" * (MIB - 100)),
    )
    yield "messages", "4 billion items told", lambda: wire_input(rollout, b"\xdd\xff\xff\xff\xff")
    yield "messages", "4 GiB of bytes told", lambda: wire_input(rollout, b"\xc6\xff\xff\xff\xff")
    yield "messages", "unknown types", lambda: wire_input(rollout, _msgpack_array(b"\xd4\x05\x00"))
    yield "messages", "a shape of 1,000 nested lists", lambda: _odd_field(_nested(900))
    yield "messages", "a shape of 300,000 sizes", lambda: _odd_field([1] * 300_000)
    yield "messages", "JSON of nested lists", lambda: wire_input(settings, b"[" * (MIB - 100))
    yield (
        "messages",
        "a policy of 1 MiB of zeros",
        lambda: wire_input(
            PolicyVersion, b"\x81\xa7weights\xc6" + struct.pack(">I", MIB - 100) + bytes(MIB - 100)
        ),
    )
    yield (
        "messages",
        "one long field name",
        lambda: wire_input(Live, b"\x81\xda\xff\x00" + b"x" * 0xFF00 + b"\xc0"),
    )
    yield "metrics", "JSON of empty maps", lambda: wire_input(metrics, _filled(b"[", b"{},", b"1]"))
    yield (
        "metrics",
        "JSON of maps of one key",
        lambda: wire_input(metrics, _filled(b"[", b'{"":0},', b"1]")),
    )
    yield (
        "metrics",
        "JSON of empty lists",
        lambda: wire_input(metrics, _filled(b"[", b"[],", b"1]")),
    )
    yield "metrics", "a number of 1,000,000 digits", lambda: wire_input(metrics, _filled(b"", b"9"))
    yield "metrics", "maps inside each other", lambda: wire_input(metrics, _filled(b"", b'{"a":'))

    yield "checkpoints", "a header of 2^60 bytes told", lambda: _safetensors(b"{}", 2**60)
    yield "checkpoints", "a header of 90 MB told", lambda: _safetensors(b"{}", 90_000_000)
    yield (
        "checkpoints",
        "15,000 empty tensors",
        lambda: _safetensors(
            json.dumps(
                {
                    f"{n}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
                    for n in range(15_000)
                }
            ).encode()
        ),
    )
    yield "checkpoints", "nested metadata", lambda: _metadata("[" * 900_000)
    yield (
        "checkpoints",
        "100,000 unknown keys",
        lambda: _policy_metadata(lambda v: v.update({str(n): 0 for n in range(60_000)})),
    )
    yield (
        "checkpoints",
        "classes that are empty lists",
        lambda: _policy_metadata(
            lambda v: v.update(
                training={
                    "sequences": [],
                    "asked": {"a": {"classes": [[]] * 250_000, "window": [0, 1]}},
                }
            )
        ),
    )
    yield (
        "checkpoints",
        "150,000 ids of sequences",
        lambda: _policy_metadata(
            lambda v: v.update(training={"sequences": [""] * 150_000, "asked": {}})
        ),
    )
    yield (
        "checkpoints",
        "100,000 numbers as ids",
        lambda: _policy_metadata(
            lambda v: v.update(training={"sequences": [1] * 99_000, "asked": {}})
        ),
    )
    yield (
        "checkpoints",
        "a shape of 300,000 sizes",
        lambda: _safetensors(
            json.dumps(
                {"a": {"dtype": "F32", "shape": [0] * 300_000, "data_offsets": [0, 0]}}
            ).encode()
        ),
    )

    for decoder in ("recordings", "recover"):
        for name, make in _recordings():
            yield decoder, name, make

    for name, make in _documents():
        yield "config", name, make
    for decoder, begin in (("joint maps", b""), ("set", b"a=")):  # they are read as YAML too
        yield decoder, "a billion values in nine lines", lambda b=begin: _laughs(b)
        yield decoder, "1,000,000 lists inside each other", lambda b=begin: _filled(b, b"[")
    yield "set", "a key of 500,000 parts", lambda: b"a." * 500_000 + b"a=1"
    yield "set", "unknown keys by aliases", lambda: b"task=" + LAUGHS.replace(b"\n", b", ")

    yield "trial log", "a million line breaks", lambda: b"\n" * MIB
    yield "trial log", "lines of one digit", lambda: b"1\n" * (MIB // 2)
    yield "trial log", "lines of 100 spaces", lambda: (b" " * 100 + b"\n") * (MIB // 101)
    yield "trial log", "a line of nested lists", lambda: b"[" * MIB
    yield "trial log", "a line of empty maps", lambda: _filled(b'{"a":[', b"{},", b"1]}")
    yield (
        "trial log",
        "a number without bound",
        lambda: (
            b'{"format": 1, "outcome": {"lenient": 1, "strict": 0, "precise": 0, "reason": "a",'
            + b' "x_m": 1'
            + b"0" * 4000
            + b"}}"
        ),
    )
    yield "outbox", "a first line of nested lists", lambda: b"[" * MIB
    yield "outbox", "a first line of empty maps", lambda: _filled(b"[", b"{},", b"1]\n")
    yield (
        "eipl",
        "a size of 2^60 sequences",
        lambda: _npy(
            b"{'descr': '<f4', 'fortran_order': False, 'shape': (1152921504606846976, 2, 11)}\n"
        ),
    )
    yield (
        "eipl",
        "a size without numbers",
        lambda: _npy(
            b"{'descr': '<f4', 'fortran_order': False, 'shape': (1152921504606846976, 2, 0)}\n"
        ),
    )
    yield "eipl", "a nested header", lambda: _npy(b"(" * 9000 + b"\n")
    yield "eipl", "a header of 1 MiB", lambda: _npy(_filled(b"{", b"1:1,", b"}"))
    yield "lerobot", "nested features", lambda: b"\0" + b"[" * (MIB - 1)
    for field in ("data_path", "video_path"):
        path = "{chunk_index:0999999999d}"
        yield "lerobot", f"a {field} of any width", lambda f=field, p=path: b"\0" + _info(**{f: p})
    yield "lerobot", "10 million rows in a few kilobytes", lambda: b"\2" + _parquet_of(10_000_000)
    yield (
        "lerobot",
        "10 million episodes in a few kilobytes",
        lambda: b"\1" + _parquet_of(10_000_000),
    )


def _info(**given: object) -> bytes:
    with TemporaryDirectory() as folder:
        valid = DECODERS["lerobot"].valid(Path(folder))[0]
    return json.dumps(json.loads(valid[1:]) | given).encode()


def _laughs(begin: bytes) -> bytes:
    return begin + (b"{" + LAUGHS.replace(b"\n", b", ") + b"}" if begin else LAUGHS)


def _documents() -> Iterator[tuple[str, Callable[[], bytes]]]:
    yield "a billion values in nine lines", lambda: LAUGHS
    yield "1,000 lists inside each other", lambda: b"[" * 1000 + b"]" * 1000
    yield "1,000,000 lists inside each other", lambda: _filled(b"", b"[")
    yield "250 KiB of lists inside each other", lambda: b"[" * 250_000
    yield "1 MiB of empty keys", lambda: _filled(b"", b"? ")
    yield "250 KiB of empty keys", lambda: b"? " * 125_000
    yield "250 KiB of dashes", lambda: b"- " * 125_000
    yield "250 KiB of values", lambda: b"[" + b"a," * 125_000 + b"a]"
    yield "a text of 250 KiB", lambda: b"run: " + b"x" * 250_000
    yield "a quoted text of 250 KiB", lambda: b'"' + b"\\n" * 125_000 + b'"'
    yield "a number of 250,000 digits", lambda: b"9" * 250_000
    yield "a hexadecimal number of 250,000 digits", lambda: b"0x" + b"f" * 250_000
    yield (
        "a long text many times",
        lambda: b"[&a " + b"x" * 200_000 + b", *a" * 9_000 + b"]",
    )
    yield "a value inside itself", lambda: b"&a [*a]"
    yield (
        "9,000 unknown keys",
        lambda: b"{" + b", ".join(b"k%d: 1" % n for n in range(4_900)) + b"}",
    )
    yield "a comment of 1 MiB", lambda: _filled(b"", b"#")


def _recordings() -> Iterator[tuple[str, Callable[[], bytes]]]:
    step = _topics("/step", "/joints", "/eye", "/tf", "/states")
    empty = _message(b"")
    yield "a chunk of 512 MiB in 17 KB", lambda: _zeros_of(0.5)
    yield "2^60 bytes told", lambda: _mcap(_chunk(b"", 2**60))
    yield "a million empty messages in one chunk", lambda: _mcap(_chunk(step + empty * 500_000))
    yield "empty messages in many chunks", lambda: _many_chunks(step + empty * 30_000)
    yield "chunks of 16 MB of zeros", lambda: _many_chunks(step + _message(bytes(16_000_000)))
    yield "chunks of 1 MB of zeros", lambda: _many_chunks(step + _message(bytes(1_000_000)))
    yield "a picture of 60 million pixels", lambda: _picture(_png(30_000, 2_000))
    yield "a picture of 30,000 x 2 pixels", lambda: _picture(_png(30_000, 2))
    yield "a picture that is told to be 64 x 48 and is not whole", lambda: _picture(_png(64, 2))
    yield (
        "a million joints in a message",
        lambda: _mcap(_chunk(step + _message(b"\x12\x00" * 500_000, 2) + empty)),
    )
    yield (
        "a hundred messages of 500,000 joints",
        lambda: _mcap(
            b"".join(_chunk(step + _message(b"\x12\x00" * 250_000, 2) + empty) for _ in range(30)),
            steps="30",
        ),
    )
    yield (
        "states of 10^12 units",
        lambda: _mcap(_chunk(step + empty), states=json.dumps({"pfc": 10**12})),
    )
    yield "outputs of 10^12 units", lambda: _mcap(_chunk(step + empty), outputs=str(10**12))
    yield (
        "a million names of bodies",
        lambda: _mcap(_chunk(step + empty), body_names=json.dumps([""] * 250_000)),
    )
    yield "nested names of bodies", lambda: _mcap(_chunk(step + empty), body_names="[" * 900_000)
    yield (
        "256 bodies in 2,000 steps",
        lambda: _mcap(
            _chunk(step + (_message(b"\x0a\x00" * 256, 4) + empty) * 2000),
            steps="2000",
            body_names=json.dumps(["a"] * 256),
        ),
    )
    yield "20,000 steps", lambda: _mcap(_chunk(step + empty * 20_000), steps="20000")
    yield (
        "60,000 metadata records",
        lambda: _filled(MAGIC + _frame(Header("", "")), _frame(Metadata("", {}))),
    )
    yield (
        "a metadata record of 100,000 texts",
        lambda: _mcap(
            b"", metadata=_frame(Metadata("episode", {str(n): "" for n in range(70_000)}))
        ),
    )
    yield (
        "60,000 schemas in a chunk",
        lambda: _mcap(
            _chunk(
                b"".join(_frame(Schema(n, b"", "", "")) for n in range(1, 60_000)) + step + empty
            )
        ),
    )
    yield "overlapping chunks", _overlapping_chunks
    yield "records that begin everywhere", lambda: _filled(b"", b"\x0c" + bytes(8))


def _cost(decoder: Decoder, content: bytes) -> dict[str, object]:
    """What reading an input costs this process: most memory (MiB), time (s), and what it raised."""
    with TemporaryDirectory(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None) as name:
        folder = Path(name)
        for valid in decoder.valid(folder):  # what is loaded at the first use is not its cost
            try:
                decoder.read(valid, folder)
            except decoder.errors:
                continue
        gc.collect()
        # Without this, freed memory of before would hide what is taken now.
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        resource.setrlimit(resource.RLIMIT_AS, (_virtual() + 1024 * MIB,) * 2)
        before = _memory("VmRSS")
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        began_s, raised, told = time.process_time(), "", ""
        try:
            decoder.read(content, folder)
        except Exception as error:
            raised, told = type(error).__name__, str(error)
            declared = isinstance(error, decoder.errors)
        else:
            declared = True
        return {
            "s": round(time.process_time() - began_s, 3),
            "mib": round((_memory("VmHWM") - before) / MIB, 1),
            "raised": raised,
            "declared": declared,
            "told": len(told),
            "text": told[-200:],
        }


def _memory(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) * 1024
    raise KeyError(name)


def _virtual() -> int:
    return _memory("VmSize")


def main() -> None:
    """Print what each case costs; each is read in a child of this process."""
    assert MESSAGES
    gc.freeze()
    wanted = sys.argv[1] if len(sys.argv) > 1 else ""
    for decoder, name, make in cases():
        if wanted not in f"{decoder}: {name}":
            continue
        content = make()
        assert len(content) <= 1.1 * MIB, (decoder, name, len(content))
        sys.stdout.flush()
        child = os.fork()
        if child == 0:
            status = 1
            try:
                found = _cost(DECODERS[decoder], content)
                print(
                    json.dumps({"decoder": decoder, "case": name, "bytes": len(content), **found})
                )
                sys.stdout.flush()
                status = 0
            finally:
                os._exit(status)
        _, status = os.waitpid(child, 0)
        if status:
            print(json.dumps({"decoder": decoder, "case": name, "died": status}))


if __name__ == "__main__":
    main()
