"""How a dataclass becomes bytes and comes back: msgpack or JSON, every field checked.

A message is a frozen dataclass. Each field says how it is checked, beside its type:

    @message("receipt", 1)
    @dataclass(frozen=True)
    class Receipt:
        episode: Annotated[str, Text(64)]

`encode` gives a `Wire` (encoding and payload), `decode` gives the dataclass back, or a
`MessageError` that names the field; no other exception comes out of a bad payload, whatever its
bytes. Arrays travel as `[dtype, shape, bytes]`, little-endian, in C order. Nothing is ever
unpickled.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Annotated, Any, Final, Literal, Protocol, TypeVar, get_args, get_origin

import msgpack
import numpy as np
from numpy.typing import NDArray

Plain = Any
"""What msgpack and JSON know: None, bool, int, float, str, bytes, lists and maps of them."""

Sizes = dict[str, int]
"""Sizes with a name that were met so far in a message, such as its number of steps T."""

MEBIBYTE: Final = 1 << 20


class MessageError(Exception):
    """A payload that is not the message it should be.

    Attributes:
        field: path of the field that is wrong, such as `episode.images`.
        problem: what is wrong with it.
    """

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}")
        self.field = field
        self.problem = problem


class Check(Protocol):
    """Packs one field into plain values, and checks them when they come back."""

    def pack(self, value: Any, /) -> Plain:
        """Plain form of a value."""

    def unpack(self, plain: Plain, where: str, sizes: Sizes, /) -> Any:
        """The value of a plain form.

        Raises:
            MessageError: it is not what this field holds.
        """


@dataclass(frozen=True)
class Integer:
    """An integer in least..most."""

    least: int = -(2**63)
    most: int = 2**63 - 1

    def pack(self, value: int) -> Plain:
        return int(value)

    def unpack(self, plain: Plain, where: str, _sizes: Sizes) -> int:
        if not isinstance(plain, int) or isinstance(plain, bool):
            raise MessageError(where, f"expected an integer, got {_kind(plain)}")
        if not self.least <= plain <= self.most:
            raise MessageError(where, f"expected {self.least}..{self.most}, got {plain}")
        return plain


@dataclass(frozen=True)
class Number:
    """A finite number in least..most."""

    least: float = -1e12
    most: float = 1e12

    def pack(self, value: float) -> Plain:
        return float(value)

    def unpack(self, plain: Plain, where: str, _sizes: Sizes) -> float:
        if not isinstance(plain, int | float) or isinstance(plain, bool):
            raise MessageError(where, f"expected a number, got {_kind(plain)}")
        if not self.least <= plain <= self.most:  # false for NaN as well
            raise MessageError(where, f"expected {self.least:g}..{self.most:g}, got {plain}")
        return float(plain)


@dataclass(frozen=True)
class Flag:
    """True or false."""

    def pack(self, value: bool) -> Plain:
        return bool(value)

    def unpack(self, plain: Plain, where: str, _sizes: Sizes) -> bool:
        if not isinstance(plain, bool):
            raise MessageError(where, f"expected true or false, got {_kind(plain)}")
        return plain


@dataclass(frozen=True)
class Text:
    """Printable text of at most `longest` characters that matches `pattern` as a whole."""

    longest: int = 256
    pattern: str | None = None

    def pack(self, value: str) -> Plain:
        return str(value)

    def unpack(self, plain: Plain, where: str, _sizes: Sizes) -> str:
        if not isinstance(plain, str):
            raise MessageError(where, f"expected text, got {_kind(plain)}")
        if len(plain) > self.longest:
            raise MessageError(
                where, f"expected at most {self.longest} characters, got {len(plain)}"
            )
        if not plain.isprintable():  # keeps terminals safe from what is logged
            raise MessageError(where, f"expected printable text, got {plain[:64]!a}")
        if self.pattern is not None and re.fullmatch(self.pattern, plain) is None:
            raise MessageError(where, f"expected {self.pattern}, got {plain[:64]!r}")
        return plain


@dataclass(frozen=True)
class NumberOrText:
    """A finite number, or text; which of the two a value is stays with it."""

    number: Number = Number()
    text: Text = Text(64)

    def pack(self, value: float | str) -> Plain:
        return value if isinstance(value, str) else self.number.pack(value)

    def unpack(self, plain: Plain, where: str, sizes: Sizes) -> float | str:
        check = self.text if isinstance(plain, str) else self.number
        return check.unpack(plain, where, sizes)


@dataclass(frozen=True)
class Choice:
    """One member of an enumeration of strings, by its value."""

    members: type[Enum]

    def pack(self, value: Enum) -> Plain:
        return str(value.value)

    def unpack(self, plain: Plain, where: str, _sizes: Sizes) -> Enum:
        for member in self.members:
            if isinstance(plain, str) and member.value == plain:
                return member
        known = ", ".join(str(member.value) for member in self.members)
        got = ascii(plain[:64]) if isinstance(plain, str) else _kind(plain)
        raise MessageError(where, f"expected one of {known}, got {got}")


@dataclass(frozen=True)
class Blob:
    """Between one and `most` bytes."""

    most: int

    def pack(self, value: bytes) -> Plain:
        return bytes(value)

    def unpack(self, plain: Plain, where: str, _sizes: Sizes) -> bytes:
        if not isinstance(plain, bytes):
            raise MessageError(where, f"expected bytes, got {_kind(plain)}")
        if not 1 <= len(plain) <= self.most:
            raise MessageError(where, f"expected 1..{self.most} bytes, got {len(plain)}")
        return plain


@dataclass(frozen=True)
class Size:
    """A size with a name: the same wherever it stands in one message, unless it is its own."""

    name: str
    least: int
    most: int
    own: bool = False

    def check(self, size: int, where: str, sizes: Sizes) -> None:
        """Take note of a size, or compare it with the one met before."""
        if not self.least <= size <= self.most:
            raise MessageError(where, f"{self.name} = {size} is not in {self.least}..{self.most}")
        if not self.own and sizes.setdefault(self.name, size) != size:
            raise MessageError(where, f"{self.name} = {size}, but elsewhere {sizes[self.name]}")


@dataclass(frozen=True)
class Array:
    """An array of one dtype and shape, its elements finite and in least..most."""

    dtype: str
    shape: tuple[int | Size, ...]
    least: float = -math.inf
    most: float = math.inf

    @cached_property
    def _own(self) -> np.dtype[Any]:
        return np.dtype(self.dtype)

    @cached_property
    def _wire(self) -> np.dtype[Any]:
        return self._own.newbyteorder("<")

    def pack(self, value: NDArray[Any]) -> Plain:
        array = np.asarray(value)
        # numpy takes longer to name a dtype than to do all the rest
        name = self.dtype if array.dtype == self._own else array.dtype.name
        content = array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
        return [name, list(array.shape), content]

    def unpack(self, plain: Plain, where: str, sizes: Sizes) -> NDArray[Any]:
        if not isinstance(plain, list) or len(plain) != 3:
            raise MessageError(where, f"expected [dtype, shape, bytes], got {_kind(plain)}")
        dtype, shape, content = plain
        if dtype != self.dtype:
            raise MessageError(where, f"expected dtype {self.dtype}, got {dtype!a:.64}")
        self._check_shape(shape, where, sizes)
        if not isinstance(content, bytes):
            raise MessageError(where, f"expected bytes as content, got {_kind(content)}")
        expected = math.prod(shape) * self._wire.itemsize
        if len(content) != expected:
            raise MessageError(where, f"expected {expected} bytes, got {len(content)}")
        # the copy is writable and in the machine's own byte order
        array = np.frombuffer(content, self._wire).reshape(shape).astype(self._own)
        self._check_range(array, where)
        return array

    def _check_shape(self, shape: Plain, where: str, sizes: Sizes) -> None:
        whole = isinstance(shape, list) and all(type(size) is int for size in shape)
        if not whole or len(shape) != len(self.shape):
            raise MessageError(where, f"expected shape {self._shape_text()}, got {shape!a:.64}")
        for expected, got in zip(self.shape, shape, strict=True):
            if isinstance(expected, Size):
                expected.check(got, where, sizes)
            elif expected != got:
                raise MessageError(where, f"expected shape {self._shape_text()}, got {shape}")

    def _shape_text(self) -> str:
        names = (size.name if isinstance(size, Size) else str(size) for size in self.shape)
        return f"[{', '.join(names)}]"

    def _check_range(self, array: NDArray[Any], where: str) -> None:
        if array.size == 0:
            return
        lowest, highest = float(array.min()), float(array.max())  # NaN if there is one
        if not (math.isfinite(lowest) and math.isfinite(highest)):
            raise MessageError(where, "expected finite numbers, got NaN or infinity")
        if not (self.least <= lowest and highest <= self.most):
            raise MessageError(
                where, f"expected {self.least:g}..{self.most:g}, got {lowest:g}..{highest:g}"
            )


@dataclass(frozen=True)
class Maybe:
    """None, or what `item` says."""

    item: Check

    def pack(self, value: Any) -> Plain:
        return None if value is None else self.item.pack(value)

    def unpack(self, plain: Plain, where: str, sizes: Sizes) -> Any:
        return None if plain is None else self.item.unpack(plain, where, sizes)


@dataclass(frozen=True)
class Added(Maybe):
    """A `Maybe` that a message got later: None is not sent, so older programs understand it."""


@dataclass(frozen=True)
class Many:
    """A tuple of items; its length is a `Size`."""

    item: Check
    size: Size

    def pack(self, value: Sequence[Any]) -> Plain:
        return [self.item.pack(item) for item in value]

    def unpack(self, plain: Plain, where: str, sizes: Sizes) -> tuple[Any, ...]:
        if not isinstance(plain, list):
            raise MessageError(where, f"expected a list, got {_kind(plain)}")
        self.size.check(len(plain), where, sizes)
        return tuple(
            self.item.unpack(item, f"{where}[{index}]", sizes) for index, item in enumerate(plain)
        )


@dataclass(frozen=True)
class Table:
    """A map from names to items, at most `most` of them."""

    item: Check
    most: int

    def pack(self, value: Mapping[str, Any]) -> Plain:
        return {str(key): self.item.pack(item) for key, item in value.items()}

    def unpack(self, plain: Plain, where: str, sizes: Sizes) -> dict[str, Any]:
        if not isinstance(plain, dict):
            raise MessageError(where, f"expected a map, got {_kind(plain)}")
        if len(plain) > self.most:
            raise MessageError(where, f"expected at most {self.most} entries, got {len(plain)}")
        name = Text(64)
        return {
            name.unpack(key, f"{where} (a key)", sizes): self.item.unpack(
                item, f"{where}[{key!a:.66}]", sizes
            )
            for key, item in plain.items()
        }


@dataclass(frozen=True)
class Record:
    """A dataclass, field by field; none may be unknown, none but those `Added` may be missing."""

    made: type[Any]
    fields: Mapping[str, Check]

    def pack(self, value: Any) -> Plain:
        return {
            name: check.pack(getattr(value, name))
            for name, check in self.fields.items()
            if not (isinstance(check, Added) and getattr(value, name) is None)
        }

    def unpack(self, plain: Plain, where: str, sizes: Sizes) -> Any:
        if not isinstance(plain, dict):
            raise MessageError(where or "payload", f"expected a map of fields, got {_kind(plain)}")
        for name in plain:
            if name not in self.fields:
                raise MessageError(_path(where, f"{name!a:.64}"), "is not a field of this message")
        values = {}
        for name, check in self.fields.items():
            if name not in plain and not isinstance(check, Added):
                raise MessageError(_path(where, name), "is missing")
            values[name] = check.unpack(plain.get(name), _path(where, name), sizes)
        try:
            return self.made(**values)
        except ValueError as error:  # fields that are valid one by one, but not together
            raise MessageError(where or "payload", str(error)) from error


@dataclass(frozen=True)
class Schema:
    """What goes over the wire under one name.

    Attributes:
        name: name of the message.
        version: raised with every change that an older program would not understand.
        form: how it is written; JSON where people and other programs read along.
        limit: most bytes of a payload.
        record: its fields.
    """

    name: str
    version: int
    form: Literal["msgpack", "json"]
    limit: int
    record: Record

    @property
    def encoding(self) -> str:
        """Zenoh encoding, such as `application/msgpack;vmdnn.receipt.1`."""
        return f"application/{self.form};vmdnn.{self.name}.{self.version}"


@dataclass(frozen=True)
class Wire:
    """An encoded message.

    Attributes:
        encoding: Zenoh encoding, see `Schema.encoding`.
        payload: its bytes.
    """

    encoding: str
    payload: bytes


Message = TypeVar("Message")
_SCHEMAS: Final[dict[type[Any], Schema]] = {}


def message(
    name: str,
    version: int,
    *,
    form: Literal["msgpack", "json"] = "msgpack",
    limit: int = 64 * 1024,
) -> Callable[[type[Message]], type[Message]]:
    """Declare a frozen dataclass to be a message; see the top of this module."""

    def declare(made: type[Message]) -> type[Message]:
        _SCHEMAS[made] = Schema(name, version, form, limit, record_of(made))
        return made

    return declare


def schema_of(made: type[Any]) -> Schema:
    """The schema of a message's class."""
    return _SCHEMAS[made]


def encode(value: Any, *, check: bool = True) -> Wire:
    """Encode a message.

    Args:
        value: the message.
        check: see whether its fields hold what they may; without it, only receivers do.

    Raises:
        MessageError: a field holds what its check does not allow: better said here, to the one
            who made it, than by every receiver.
    """
    schema = _SCHEMAS[type(value)]
    plain = schema.record.pack(value)
    if check:
        schema.record.unpack(plain, "", {})
    if schema.form == "json":
        payload = json.dumps(plain, allow_nan=False).encode()
    else:
        payload = msgpack.packb(plain)
    _check_length(payload, schema)
    return Wire(schema.encoding, payload)


def decode(wire: Wire, *classes: type[Message]) -> Message:
    """Decode a message of one of `classes`; its encoding tells which.

    Raises:
        MessageError: it is another message, another version, or a field is not as it should be.
    """
    schemas = [_SCHEMAS[made] for made in classes]
    schema = next((schema for schema in schemas if schema.encoding == wire.encoding), None)
    if schema is None:
        expected = " or ".join(schema.encoding for schema in schemas)
        raise MessageError(
            "encoding",
            f"expected {expected}, got {wire.encoding[:128]!a}: do both ends run the same "
            "version of vmdnn?",
        )
    _check_length(wire.payload, schema)
    read = _read_json if schema.form == "json" else _read_msgpack
    value: Message = schema.record.unpack(read(wire.payload), "", {})
    return value


def _check_length(payload: bytes, schema: Schema) -> None:
    if len(payload) > schema.limit:
        raise MessageError("payload", f"expected at most {schema.limit} bytes, got {len(payload)}")


def _read_msgpack(payload: bytes) -> Plain:
    try:
        return msgpack.unpackb(payload)
    except (ValueError, msgpack.UnpackException) as error:
        raise MessageError("payload", f"is not msgpack: {str(error)[:128]}") from error


def _read_json(payload: bytes) -> Plain:
    try:
        return json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise MessageError("payload", f"is not JSON: {str(error)[:128]}") from error


def record_of(made: type[Any]) -> Record:
    """The checks of a dataclass's fields, from their annotations.

    Raises:
        TypeError: a field's annotation does not say how to check it.
    """
    hints = typing.get_type_hints(made, include_extras=True)
    return Record(
        made,
        {
            field.name: _check_of(hints[field.name], f"{made.__name__}.{field.name}")
            for field in dataclasses.fields(made)
        },
    )


_OF_PLAIN_TYPES: Final[Mapping[Any, Check]] = {
    bool: Flag(),
    int: Integer(),
    float: Number(),
    str: Text(),
}


def _check_of(hint: Any, where: str) -> Check:
    if get_origin(hint) is Annotated:
        check: Check = get_args(hint)[1]
        return check
    if hint in _OF_PLAIN_TYPES:
        return _OF_PLAIN_TYPES[hint]
    if isinstance(hint, type) and issubclass(hint, Enum):
        return Choice(hint)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return record_of(hint)
    raise TypeError(f"{where}: write Annotated[{hint}, ...] to say how it is checked")


def _path(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _kind(plain: Plain) -> str:
    names = {dict: "a map", list: "a list", str: "text", type(None): "nothing"}
    return names.get(type(plain), type(plain).__name__)
