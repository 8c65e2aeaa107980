"""Encoding of dataclasses as msgpack or JSON, and decoding with a check of every field.

A message is a frozen dataclass. The annotation of each field names its type and its check:

    @message("receipt", 1)
    @dataclass(frozen=True)
    class Receipt:
        episode: Annotated[str, Text(64)]

`encode` returns a `Wire` (encoding and payload). `decode` returns the dataclass, or raises a
`MessageError` that names the invalid field; a bad payload raises no other exception. Arrays are
encoded as `[dtype, shape, bytes]`, little-endian, in C order. Pickle is never used.
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
"""A value that msgpack or JSON can hold: None, bool, int, float, str, bytes, lists, maps."""

Sizes = dict[str, int]
"""Named sizes found so far in a message, such as its number of steps T."""

MEBIBYTE: Final = 1 << 20
_COUNTED_FROM: Final = 64 * 1024
"""The values in a smaller payload are not counted while it is decoded (bytes)."""
_LONGEST_FIELD: Final = 300
_LONGEST_PROBLEM: Final = 1000


class MessageError(Exception):
    """An invalid message.

    Attributes:
        field: path of the invalid field, such as `episode.images`.
        problem: what is wrong with it.
    """

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(field, problem)
        self.field = field[:_LONGEST_FIELD]
        self.problem = problem[:_LONGEST_PROBLEM]

    def __str__(self) -> str:
        return f"{self.field}: {self.problem}"

    def prefix(self, outer: str) -> None:
        """Put the path of what holds the field in front; paths are made for errors only."""
        joint = "." if self.field[:1] not in ("", "[", " ") else ""
        self.field = f"{outer}{joint}{self.field}"[:_LONGEST_FIELD]


def _invalid(problem: str) -> MessageError:
    """A problem of a value itself; what holds the value puts the path in front."""
    return MessageError("", problem)


class Check(Protocol):
    """Converts one field to plain values, and back with a check."""

    def pack(self, value: Any, /) -> Plain:
        """Convert a value to its plain form."""

    def unpack(self, plain: Plain, sizes: Sizes, /) -> Any:
        """Convert a plain form to the value.

        Args:
            plain: the plain form.
            sizes: named sizes of the message; the sizes of this field are added.

        Raises:
            MessageError: the plain form is not valid for this field; its path begins here.
        """

    @property
    def most_values(self) -> int:
        """Largest number of lists, maps and their items in a valid plain form, itself included."""


class _Single:
    """A check of a form that holds nothing else."""

    @property
    def most_values(self) -> int:
        return 1


@dataclass(frozen=True)
class Integer(_Single):
    """An integer in least..most."""

    least: int = -(2**63)
    most: int = 2**63 - 1

    def pack(self, value: int) -> Plain:
        return int(value)

    def unpack(self, plain: Plain, _sizes: Sizes) -> int:
        if not isinstance(plain, int) or isinstance(plain, bool):
            raise _invalid(f"expected an integer, got {_kind(plain)}")
        if not self.least <= plain <= self.most:
            raise _invalid(f"expected {self.least}..{self.most}, got {plain}")
        return plain


@dataclass(frozen=True)
class Number(_Single):
    """A finite number in least..most."""

    least: float = -1e12
    most: float = 1e12

    def pack(self, value: float) -> Plain:
        return float(value)

    def unpack(self, plain: Plain, _sizes: Sizes) -> float:
        if not isinstance(plain, int | float) or isinstance(plain, bool):
            raise _invalid(f"expected a number, got {_kind(plain)}")
        if not self.least <= plain <= self.most:  # false for NaN as well
            raise _invalid(f"expected {self.least:g}..{self.most:g}, got {plain}")
        return float(plain)


@dataclass(frozen=True)
class Flag(_Single):
    """True or false."""

    def pack(self, value: bool) -> Plain:
        return bool(value)

    def unpack(self, plain: Plain, _sizes: Sizes) -> bool:
        if not isinstance(plain, bool):
            raise _invalid(f"expected true or false, got {_kind(plain)}")
        return plain


@dataclass(frozen=True)
class Text(_Single):
    """Printable text of at most `longest` characters that matches `pattern` as a whole."""

    longest: int = 256
    pattern: str | None = None

    def pack(self, value: str) -> Plain:
        return str(value)

    def unpack(self, plain: Plain, _sizes: Sizes) -> str:
        if not isinstance(plain, str):
            raise _invalid(f"expected text, got {_kind(plain)}")
        if len(plain) > self.longest:
            raise _invalid(f"expected at most {self.longest} characters, got {len(plain)}")
        if not plain.isprintable():  # keeps terminals safe from what is logged
            raise _invalid(f"expected printable text, got {plain[:64]!a}")
        if self._fullmatch is not None and self._fullmatch(plain) is None:
            raise _invalid(f"expected {self.pattern}, got {plain[:64]!r}")
        return plain

    @cached_property
    def _fullmatch(self) -> Callable[[str], re.Match[str] | None] | None:
        return None if self.pattern is None else re.compile(self.pattern).fullmatch


@dataclass(frozen=True)
class NumberOrText(_Single):
    """A finite number or a text; a number stays a number, a text stays a text."""

    number: Number = Number()
    text: Text = Text(64)

    def pack(self, value: float | str) -> Plain:
        return value if isinstance(value, str) else self.number.pack(value)

    def unpack(self, plain: Plain, sizes: Sizes) -> float | str:
        check = self.text if isinstance(plain, str) else self.number
        return check.unpack(plain, sizes)


@dataclass(frozen=True)
class Choice(_Single):
    """One member of an enumeration of strings, by its value."""

    members: type[Enum]

    def pack(self, value: Enum) -> Plain:
        return str(value.value)

    def unpack(self, plain: Plain, _sizes: Sizes) -> Enum:
        if isinstance(plain, str) and plain in self._by_value:
            return self._by_value[plain]
        known = ", ".join(self._by_value)
        got = ascii(plain[:64]) if isinstance(plain, str) else _kind(plain)
        raise _invalid(f"expected one of {known}, got {got}")

    @cached_property
    def _by_value(self) -> dict[str, Enum]:
        return {str(member.value): member for member in self.members}


@dataclass(frozen=True)
class Blob(_Single):
    """Between one and `most` bytes."""

    most: int

    def pack(self, value: bytes) -> Plain:
        return bytes(value)

    def unpack(self, plain: Plain, _sizes: Sizes) -> bytes:
        if not isinstance(plain, bytes):
            raise _invalid(f"expected bytes, got {_kind(plain)}")
        if not 1 <= len(plain) <= self.most:
            raise _invalid(f"expected 1..{self.most} bytes, got {len(plain)}")
        return plain


@dataclass(frozen=True)
class Size:
    """A named size in least..most, such as the number of steps T.

    All fields of a message that use the name must have the same size, unless it `varies`.
    """

    name: str
    least: int
    most: int
    varies: bool = False

    def check(self, size: int, sizes: Sizes) -> None:
        """Check the range of a size, and that it equals the size of this name in `sizes`.

        The first size of a name is added to `sizes`.

        Raises:
            MessageError: the size is out of range or differs.
        """
        if not self.least <= size <= self.most:
            raise _invalid(f"{self.name} = {size} is not in {self.least}..{self.most}")
        if not self.varies and sizes.setdefault(self.name, size) != size:
            raise _invalid(f"{self.name} = {size}, but elsewhere {sizes[self.name]}")


@dataclass(frozen=True)
class Array:
    """An array of a given dtype and shape whose elements are finite and in least..most."""

    dtype: str
    shape: tuple[int | Size, ...]
    least: float = -math.inf
    most: float = math.inf

    @cached_property
    def _native(self) -> np.dtype[Any]:
        return np.dtype(self.dtype)

    @cached_property
    def _little_endian(self) -> np.dtype[Any]:
        return self._native.newbyteorder("<")

    @property
    def most_values(self) -> int:
        return 4 + len(self.shape)

    def pack(self, value: NDArray[Any]) -> Plain:
        array = np.asarray(value)
        # `dtype.name` is slow: it would take longer than the rest of this function.
        name = self.dtype if array.dtype == self._native else array.dtype.name
        content = array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
        return [name, list(array.shape), content]

    def unpack(self, plain: Plain, sizes: Sizes) -> NDArray[Any]:
        if not isinstance(plain, list) or len(plain) != 3:
            raise _invalid(f"expected [dtype, shape, bytes], got {_kind(plain)}")
        dtype, shape, content = plain
        if dtype != self.dtype:
            raise _invalid(f"expected dtype {self.dtype}, got {_shown(dtype)}")
        self._check_shape(shape, sizes)
        if not isinstance(content, bytes):
            raise _invalid(f"expected bytes as content, got {_kind(content)}")
        expected = math.prod(shape) * self._little_endian.itemsize
        if len(content) != expected:
            raise _invalid(f"expected {expected} bytes, got {len(content)}")
        # The copy is writable and in the machine's byte order.
        array = np.frombuffer(content, self._little_endian).reshape(shape).astype(self._native)
        self._check_range(array)
        return array

    def _check_shape(self, shape: Plain, sizes: Sizes) -> None:
        whole = isinstance(shape, list) and all(type(size) is int for size in shape)
        if not whole or len(shape) != len(self.shape):
            raise _invalid(f"expected shape {self._shape_text()}, got {_shown(shape)}")
        for expected, got in zip(self.shape, shape, strict=True):
            if isinstance(expected, Size):
                expected.check(got, sizes)
            elif expected != got:
                raise _invalid(f"expected shape {self._shape_text()}, got {shape}")

    def _shape_text(self) -> str:
        names = (size.name if isinstance(size, Size) else str(size) for size in self.shape)
        return f"[{', '.join(names)}]"

    def _check_range(self, array: NDArray[Any]) -> None:
        if array.size == 0:
            return
        lowest, highest = float(array.min()), float(array.max())  # NaN if an element is NaN
        if not (math.isfinite(lowest) and math.isfinite(highest)):
            raise _invalid("expected finite numbers, got NaN or infinity")
        if not (self.least <= lowest and highest <= self.most):
            raise _invalid(f"expected {self.least:g}..{self.most:g}, got {lowest:g}..{highest:g}")


@dataclass(frozen=True)
class Maybe:
    """None, or a value that `item` allows."""

    item: Check

    @property
    def most_values(self) -> int:
        return self.item.most_values

    def pack(self, value: Any) -> Plain:
        return None if value is None else self.item.pack(value)

    def unpack(self, plain: Plain, sizes: Sizes) -> Any:
        return None if plain is None else self.item.unpack(plain, sizes)


@dataclass(frozen=True)
class Added(Maybe):
    """A `Maybe` for a field that was added later to a message.

    None is not sent, so that older programs can decode the message.
    """


@dataclass(frozen=True)
class Many:
    """A tuple of items; its length is a `Size`."""

    item: Check
    size: Size

    @property
    def most_values(self) -> int:
        return 1 + self.size.most * self.item.most_values

    def pack(self, value: Sequence[Any]) -> Plain:
        return [self.item.pack(item) for item in value]

    def unpack(self, plain: Plain, sizes: Sizes) -> tuple[Any, ...]:
        if not isinstance(plain, list):
            raise _invalid(f"expected a list, got {_kind(plain)}")
        self.size.check(len(plain), sizes)
        unpack = self.item.unpack
        items: list[Any] = []
        try:
            for item in plain:
                items.append(unpack(item, sizes))  # noqa: PERF401 (the error needs the index)
        except MessageError as error:
            error.prefix(f"[{len(items)}]")
            raise
        return tuple(items)


_NAME: Final = Text(64)


@dataclass(frozen=True)
class Table:
    """A map from names to items, at most `most` of them."""

    item: Check
    most: int

    @property
    def most_values(self) -> int:
        return 1 + self.most * self.item.most_values

    def pack(self, value: Mapping[str, Any]) -> Plain:
        return {str(key): self.item.pack(item) for key, item in value.items()}

    def unpack(self, plain: Plain, sizes: Sizes) -> dict[str, Any]:
        if not isinstance(plain, dict):
            raise _invalid(f"expected a map, got {_kind(plain)}")
        if len(plain) > self.most:
            raise _invalid(f"expected at most {self.most} entries, got {len(plain)}")
        unpack = self.item.unpack
        values: dict[str, Any] = {}
        for key, item in plain.items():
            try:
                values[_NAME.unpack(key, sizes)] = unpack(item, sizes)
            except MessageError as error:
                error.prefix(f"[{_shown(key)}]")
                raise
        return values


@dataclass(frozen=True)
class Record:
    """A dataclass, as a map of its fields.

    Unknown fields are refused. Missing fields are refused, except those that are `Added`.
    """

    record_class: type[Any]
    fields: Mapping[str, Check]

    @property
    def most_values(self) -> int:
        return 1 + sum(check.most_values for check in self.fields.values())

    def pack(self, value: Any) -> Plain:
        plain = {name: pack(getattr(value, name)) for name, pack in self._packing}
        for name in self._added:
            if plain[name] is None:
                del plain[name]
        return plain

    @cached_property
    def _packing(self) -> tuple[tuple[str, Callable[[Any], Plain]], ...]:
        return tuple((name, check.pack) for name, check in self.fields.items())

    @cached_property
    def _unpacking(self) -> tuple[tuple[str, Callable[[Plain, Sizes], Any]], ...]:
        return tuple((name, check.unpack) for name, check in self.fields.items())

    @cached_property
    def _added(self) -> tuple[str, ...]:
        return tuple(name for name, check in self.fields.items() if isinstance(check, Added))

    def unpack(self, plain: Plain, sizes: Sizes) -> Any:
        if not isinstance(plain, dict):
            raise _invalid(f"expected a map of fields, got {_kind(plain)}")
        if not plain.keys() <= self.fields.keys():
            unknown = next(name for name in plain if name not in self.fields)
            raise MessageError(_shown(unknown), "is not a field of this message")
        values = {}
        name = ""
        try:
            for name, unpack in self._unpacking:
                if name in plain:
                    values[name] = unpack(plain[name], sizes)
                elif name in self._added:
                    values[name] = None
                else:
                    raise _invalid("is missing")
        except MessageError as error:
            error.prefix(name)
            raise
        try:
            return self.record_class(**values)
        except ValueError as error:  # each field is valid, but not their combination
            raise _invalid(str(error)) from error


@dataclass(frozen=True)
class Schema:
    """The encoding of one message class.

    Attributes:
        name: name of the message.
        version: increased with every change that an older program cannot decode.
        form: format of the payload; JSON if people or other programs read the message.
        limit: largest size of a payload (bytes).
        record: the checks of its fields.
    """

    name: str
    version: int
    form: Literal["msgpack", "json"]
    limit: int
    record: Record

    @cached_property
    def most_values(self) -> int:
        """Largest number of lists, maps and their items in a valid payload."""
        return self.record.most_values

    @cached_property
    def encoding(self) -> str:
        """Zenoh encoding, such as `application/msgpack;vmdnn.receipt.1`."""
        return f"application/{self.form};vmdnn.{self.name}.{self.version}"

    def check_size(self, size: int, limit: int | None = None) -> None:
        """Raise MessageError if a payload is larger than `self.limit`, or than `limit`."""
        most = self.limit if limit is None else min(limit, self.limit)
        if size > most:
            raise MessageError("payload", f"expected at most {most} bytes, got {size}")

    def unpack(self, plain: Plain) -> Any:
        """Convert a plain form to the message; raises MessageError."""
        try:
            return self.record.unpack(plain, {})
        except MessageError as error:
            if not error.field:
                error.prefix("payload")
            raise


@dataclass(frozen=True)
class Wire:
    """An encoded message.

    Attributes:
        encoding: Zenoh encoding, see `Schema.encoding`.
        payload: the encoded bytes.
    """

    encoding: str
    payload: bytes


Message = TypeVar("Message")
_JSON: Final = json.JSONEncoder(allow_nan=False)
_SCHEMAS: Final[dict[type[Any], Schema]] = {}


def message(
    name: str,
    version: int,
    *,
    form: Literal["msgpack", "json"] = "msgpack",
    limit: int = 64 * 1024,
) -> Callable[[type[Message]], type[Message]]:
    """Return a decorator that registers a frozen dataclass as a message.

    The docstring of this module shows an example; `Schema` documents the arguments.
    """

    def register(message_class: type[Message]) -> type[Message]:
        _SCHEMAS[message_class] = Schema(name, version, form, limit, record_of(message_class))
        return message_class

    return register


def schema_of(message_class: type[Any]) -> Schema:
    """Return the schema of a message class."""
    return _SCHEMAS[message_class]


def encode(value: Any, *, check: bool = True) -> Wire:
    """Encode a message.

    Args:
        value: the message.
        check: check the fields here too; otherwise only receivers check them.

    Raises:
        MessageError: a field is not valid. The sender learns of it here, before every receiver
            would drop the message.
    """
    schema = _SCHEMAS[type(value)]
    plain = schema.record.pack(value)
    if check:
        schema.unpack(plain)
    payload = _JSON.encode(plain).encode() if schema.form == "json" else msgpack.packb(plain)
    schema.check_size(len(payload))
    return Wire(schema.encoding, payload)


def decode(wire: Wire, *classes: type[Message], limit: int | None = None) -> Message:
    """Decode a message of one of `classes`; the encoding selects the class.

    Args:
        wire: the encoded message.
        classes: classes that it may have.
        limit: largest size of a payload here, where it is less than that of the class (bytes).

    Raises:
        MessageError: it is a message of another class or version, or a field is not valid.
    """
    schema = _schema_by(wire.encoding, classes)
    schema.check_size(len(wire.payload), limit)
    read = _read_json if schema.form == "json" else _read_msgpack
    value: Message = schema.unpack(read(wire.payload, schema.most_values))
    return value


def check_size(size: int, encoding: str, *classes: type[Any], limit: int | None = None) -> None:
    """Refuse a payload that is too large, before it is copied; arguments as in `decode`.

    Raises:
        MessageError: it is too large, or of none of `classes`.
    """
    _schema_by(encoding, classes).check_size(size, limit)


def _schema_by(encoding: str, classes: Sequence[type[Any]]) -> Schema:
    for message_class in classes:
        schema = _SCHEMAS[message_class]
        if schema.encoding == encoding:
            return schema
    expected = " or ".join(_SCHEMAS[message_class].encoding for message_class in classes)
    raise MessageError(
        "encoding",
        f"expected {expected}, got {encoding[:128]!a}: do both ends run the same version of vmdnn?",
    )


class _Budget:
    """Counts lists, maps and their items while a large payload is decoded.

    A byte of msgpack can be a map, which takes 64 bytes of memory. A small payload can do no harm.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._left = most

    def take(self, count: int) -> None:
        """Count some; ValueError if there are too many."""
        self._left -= count
        if self._left < 0:
            raise ValueError(f"it has more than {self._most} values")

    def list_hook(self, items: list[Any]) -> list[Any]:
        """Count a list."""
        self.take(1 + len(items))
        return items

    def map_hook(self, items: list[tuple[Any, Any]]) -> dict[Any, Any]:
        """Count a map."""
        self.take(1 + len(items))
        return dict(items)


def _read_msgpack(payload: bytes, most_values: int) -> Plain:
    hooks: dict[str, Any] = {}
    if len(payload) >= _COUNTED_FROM:
        budget = _Budget(2 * most_values)  # an item that is a list or a map counts twice
        hooks = {"list_hook": budget.list_hook, "object_pairs_hook": budget.map_hook}
    try:
        return msgpack.unpackb(
            payload, max_array_len=most_values, max_map_len=most_values, max_ext_len=0, **hooks
        )
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise MessageError("payload", f"is not msgpack: {str(error)[:128]}") from error


def _read_json(payload: bytes, most_values: int) -> Plain:
    hook = _Budget(2 * most_values).map_hook if len(payload) >= _COUNTED_FROM else None
    try:
        return json.loads(payload, object_pairs_hook=hook)
    except (ValueError, RecursionError) as error:
        raise MessageError("payload", f"is not JSON: {str(error)[:128]}") from error


def record_of(record_class: type[Any]) -> Record:
    """Make the checks of a dataclass's fields from their annotations.

    Raises:
        TypeError: a field's annotation contains no check.
    """
    hints = typing.get_type_hints(record_class, include_extras=True)
    return Record(
        record_class,
        {
            field.name: _check_of(hints[field.name], f"{record_class.__name__}.{field.name}")
            for field in dataclasses.fields(record_class)
        },
    )


_CHECKS_OF_PLAIN_TYPES: Final[Mapping[Any, Check]] = {
    bool: Flag(),
    int: Integer(),
    float: Number(),
    str: Text(),
}


def _check_of(hint: Any, where: str) -> Check:
    if get_origin(hint) is Annotated:
        check: Check = get_args(hint)[1]
        return check
    if hint in _CHECKS_OF_PLAIN_TYPES:
        return _CHECKS_OF_PLAIN_TYPES[hint]
    if isinstance(hint, type) and issubclass(hint, Enum):
        return Choice(hint)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return record_of(hint)
    raise TypeError(f"{where}: write Annotated[{hint}, ...] to say how it is checked")


def _shown(plain: Plain) -> str:
    """A value from outside, for an error: the beginning of a text, or the kind of what it is."""
    if isinstance(plain, str | bytes):
        return ascii(plain[:64])
    return str(plain) if isinstance(plain, int) and abs(plain) < 2**64 else _kind(plain)


def _kind(plain: Plain) -> str:
    names = {dict: "a map", list: "a list", str: "text", type(None): "nothing"}
    return names.get(type(plain), type(plain).__name__)
