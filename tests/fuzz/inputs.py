"""Makes inputs from a seed, a decoder's name and a number: damaged valid ones and hostile ones."""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Sequence

SEED = int(os.environ.get("VMDNN_FUZZ_SEED", "1"))

INTERESTING = (
    b"\x00", b"\xff", b"\x7f", b"\x80", b"\xc0", b"\xc1", b"\xdd\xff\xff\xff\xff",
    b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xd9\xff", b"\xcb\x7f\xf8\0\0\0\0\0\0",
    b"\xff" * 8, b"\0" * 8, b"\0\0\0\0\0\0\0\x80", b"[", b"]", b"{", b"}", b'"', b"\\", b"\\ud800",
    b"NaN", b"-Infinity", b"1e999", b"null", b"true", b"9" * 400, b"\n", b"\x1b[2J", b"../../x",
    b"&a ", b"*a", b"!!timestamp ", b"!!python/object:os.system ", b"? ", b": ", b"- ", b"|\n",
    b"%",
    b"\xf0\x9f\xa4\x96", b"\xc3\x28",
)  # fmt: skip

Random = random.Random


def make_input(seed: int, decoder: str, number: int, valid: Sequence[bytes]) -> bytes:
    """The input with a number; the same arguments always give the same input."""
    chance = random.Random(f"{seed}/{decoder}/{number}")
    content = bytearray(chance.choice(valid))
    if chance.random() < 0.03:
        return chance.randbytes(chance.randrange(300))
    for _ in range(chance.choice((1, 1, 1, 2, 3, 8))):
        chance.choice(MUTATIONS)(content, chance, valid)
    return bytes(content)


def _place(content: bytearray, chance: Random) -> int:
    """Where to change something: half of the time near the beginning, where the structure is."""
    end = len(content) + 1
    return chance.randrange(min(end, 200) if chance.random() < 0.5 else end)


def _flip(content: bytearray, chance: Random, _valid: Sequence[bytes]) -> None:
    if content:
        content[_place(content, chance) % len(content)] ^= 1 << chance.randrange(8)


def _set(content: bytearray, chance: Random, _valid: Sequence[bytes]) -> None:
    if content:
        content[_place(content, chance) % len(content)] = chance.randrange(256)


def _overwrite(content: bytearray, chance: Random, _valid: Sequence[bytes]) -> None:
    at, piece = _place(content, chance), chance.choice(INTERESTING)
    content[at : at + len(piece)] = piece


def _insert(content: bytearray, chance: Random, _valid: Sequence[bytes]) -> None:
    at = _place(content, chance)
    content[at:at] = chance.choice(INTERESTING)


def _insert_many(content: bytearray, chance: Random, _valid: Sequence[bytes]) -> None:
    at = _place(content, chance)
    content[at:at] = chance.choice(INTERESTING) * chance.randrange(2, 300)


def _cut(content: bytearray, chance: Random, _valid: Sequence[bytes]) -> None:
    del content[_place(content, chance) :]


def _delete(content: bytearray, chance: Random, _valid: Sequence[bytes]) -> None:
    at = _place(content, chance)
    del content[at : at + chance.randrange(1, 64)]


def _repeat(content: bytearray, chance: Random, _valid: Sequence[bytes]) -> None:
    at = _place(content, chance)
    piece = content[at : at + chance.randrange(1, 64)]
    content[at:at] = piece * chance.randrange(1, 20)


def _splice(content: bytearray, chance: Random, valid: Sequence[bytes]) -> None:
    other = chance.choice(valid)
    begin = chance.randrange(len(other) + 1)
    content[_place(content, chance) :] = other[begin:]


MUTATIONS: tuple[Callable[[bytearray, Random, Sequence[bytes]], None], ...] = (
    *(_flip, _flip, _flip, _set, _set, _overwrite, _overwrite, _insert, _insert),
    *(_insert_many, _cut, _delete, _repeat, _splice),
)
