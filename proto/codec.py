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
_LONGEST_FIELD: Final = 300
_LONGEST_PROBLEM: Final = 1000


class MessageError(Exception):
    """An invalid message.

    Attributes:
        field: path of the invalid field, such as `episode.images`.
        problem: what is wrong with it.
    """

    def __init__(self, field: str, problem: str) -> None:
        self.field = field[:_LONGEST_FIELD]
        self.problem = problem[:_LONGEST_PROBLEM]
        super().__init__(f"{self.field}: {self.problem}")


class Check(Protocol):
    """Converts one field to plain values, and back with a check."""

    def pack(self, value: Any, /) -> Plain:
        """Convert a value to its plain form."""

    def unpack(self, plain: Plain, where: str, sizes: Sizes, /) -> Any:
        """Convert a plain form to the value.

        Args:
            plain: the plain form.
            where: path of the field, for the error.
            sizes: named sizes of the message; the sizes of this field are added.

        Raises:
            MessageError: the plain form is not valid for this field.
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

    def unpack(self, plain: Plain, where: str, _sizes: Sizes) -> int:
        if not isinstance(plain, int) or isinstance(plain, bool):
            raise MessageError(where, f"expected an integer, got {_kind(plain)}")
        if not self.least <= plain <= self.most:
            raise MessageError(where, f"expected {self.least}..{self.most}, got {plain}")
        return plain


@dataclass(frozen=True)
class Number(_Single):
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
class Flag(_Single):
    """True or false."""

    def pack(self, value: bool) -> Plain:
        return bool(value)

    def unpack(self, plain: Plain, where: str, _sizes: Sizes) -> bool:
        if not isinstance(plain, bool):
            raise MessageError(where, f"expected true or false, got {_kind(plain)}")
        return plain


@dataclass(frozen=True)
class Text(_Single):
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
class NumberOrText(_Single):
    """A finite number or a text; a number stays a number, a text stays a text."""

    number: Number = Number()
    text: Text = Text(64)

    def pack(self, value: float | str) -> Plain:
        return value if isinstance(value, str) else self.number.pack(value)

    def unpack(self, plain: Plain, where: str, sizes: Sizes) -> float | str:
        check = self.text if isinstance(plain, str) else self.number
        return check.unpack(plain, where, sizes)


@dataclass(frozen=True)
class Choice(_Single):
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
class Blob(_Single):
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
    """A named size in least..most, such as the number of steps T.

    All fields of a message that use the name must have the same size, unless it `varies`.
    """

    name: str
    least: int
    most: int
    varies: bool = False

    def check(self, size: int, where: str, sizes: Sizes) -> None:
        """Check the range of a size, and that it equals the size of this name in `sizes`.

        The first size of a name is added to `sizes`.

        Raises:
            MessageError: the size is out of range or differs.
        """
        if not self.least <= size <= self.most:
            raise MessageError(where, f"{self.name} = {size} is not in {self.least}..{self.most}")
        if not self.varies and sizes.setdefault(self.name, size) != size:
            raise MessageError(where, f"{self.name} = {size}, but elsewhere {sizes[self.name]}")


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

    def unpack(self, plain: Plain, where: str, sizes: Sizes) -> NDArray[Any]:
        if not isinstance(plain, list) or len(plain) != 3:
            raise MessageError(where, f"expected [dtype, shape, bytes], got {_kind(plain)}")
        dtype, shape, content = plain
        if dtype != self.dtype:
            raise MessageError(where, f"expected dtype {self.dtype}, got {_shown(dtype)}")
        self._check_shape(shape, where, sizes)
        if not isinstance(content, bytes):
            raise MessageError(where, f"expected bytes as content, got {_kind(content)}")
        expected = math.prod(shape) * self._little_endian.itemsize
        if len(content) != expected:
            raise MessageError(where, f"expected {expected} bytes, got {len(content)}")
        # The copy is writable and in the machine's byte order.
        array = np.frombuffer(content, self._little_endian).reshape(shape).astype(self._native)
        self._check_range(array, where)
        return array

    def _check_shape(self, shape: Plain, where: str, sizes: Sizes) -> None:
        whole = isinstance(shape, list) and all(type(size) is int for size in shape)
        if not whole or len(shape) != len(self.shape):
            raise MessageError(where, f"expected shape {self._shape_text()}, got {_shown(shape)}")
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
        lowest, highest = float(array.min()), float(array.max())  # NaN if an element is NaN
        if not (math.isfinite(lowest) and math.isfinite(highest)):
            raise MessageError(where, "expected finite numbers, got NaN or infinity")
        if not (self.least <= lowest and highest <= self.most):
            raise MessageError(
                where, f"expected {self.least:g}..{self.most:g}, got {lowest:g}..{highest:g}"
            )


@dataclass(frozen=True)
class Maybe:
    """None, or a value that `item` allows."""

    item: Check

    @property
    def most_values(self) -> int:
        return self.item.most_values

    def pack(self, value: Any) -> Plain:
        return None if value is None else self.item.pack(value)

    def unpack(self, plain: Plain, where: str, sizes: Sizes) -> Any:
        return None if plain is None else self.item.unpack(plain, where, sizes)


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

    @property
    def most_values(self) -> int:
        return 1 + self.most * self.item.most_values

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
                item, f"{where}[{_shown(key)}]", sizes
            )
            for key, item in plain.items()
        }


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
                raise MessageError(_path(where, _shown(name)), "is not a field of this message")
        values = {}
        for name, check in self.fields.items():
            if name not in plain and not isinstance(check, Added):
                raise MessageError(_path(where, name), "is missing")
            values[name] = check.unpack(plain.get(name), _path(where, name), sizes)
        try:
            return self.record_class(**values)
        except ValueError as error:  # each field is valid, but not their combination
            raise MessageError(where or "payload", str(error)) from error


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

    @property
    def encoding(self) -> str:
        """Zenoh encoding, such as `application/msgpack;vmdnn.receipt.1`."""
        return f"application/{self.form};vmdnn.{self.name}.{self.version}"


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
        schema.record.unpack(plain, "", {})
    if schema.form == "json":
        payload = json.dumps(plain, allow_nan=False).encode()
    else:
        payload = msgpack.packb(plain)
    check_size(len(payload), schema.encoding, type(value))
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
    check_size(len(wire.payload), wire.encoding, *classes, limit=limit)
    read = _read_json if schema.form == "json" else _read_msgpack
    value: Message = schema.record.unpack(read(wire.payload, schema.most_values), "", {})
    return value


def check_size(size: int, encoding: str, *classes: type[Any], limit: int | None = None) -> None:
    """Refuse a payload that is too large, before it is copied; arguments as in `decode`.

    Raises:
        MessageError: it is too large, or of none of `classes`.
    """
    schema = _schema_by(encoding, classes)
    most = schema.limit if limit is None else min(limit, schema.limit)
    if size > most:
        raise MessageError("payload", f"expected at most {most} bytes, got {size}")


def _schema_by(encoding: str, classes: Sequence[type[Any]]) -> Schema:
    schemas = [_SCHEMAS[message_class] for message_class in classes]
    schema = next((schema for schema in schemas if schema.encoding == encoding), None)
    if schema is None:
        expected = " or ".join(schema.encoding for schema in schemas)
        raise MessageError(
            "encoding",
            f"expected {expected}, got {encoding[:128]!a}: do both ends run the same "
            "version of vmdnn?",
        )
    return schema


class _Budget:
    """Counts lists, maps and their items while a payload is decoded.

    A byte of msgpack can be a map, which takes 64 bytes of memory.
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
    budget = _Budget(2 * most_values)  # an item that is a list or a map counts twice
    try:
        return msgpack.unpackb(
            payload,
            list_hook=budget.list_hook,
            object_pairs_hook=budget.map_hook,
            max_array_len=most_values,
            max_map_len=most_values,
            max_ext_len=0,
        )
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise MessageError("payload", f"is not msgpack: {str(error)[:128]}") from error


def _read_json(payload: bytes, most_values: int) -> Plain:
    budget = _Budget(2 * most_values)
    try:
        return json.loads(payload, object_pairs_hook=budget.map_hook)
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


def _path(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _shown(plain: Plain) -> str:
    """A value from outside, for an error: the beginning of a text, or the kind of what it is."""
    if isinstance(plain, str | bytes):
        return ascii(plain[:64])
    return str(plain) if isinstance(plain, int) and abs(plain) < 2**64 else _kind(plain)


def _kind(plain: Plain) -> str:
    names = {dict: "a map", list: "a list", str: "text", type(None): "nothing"}
    return names.get(type(plain), type(plain).__name__)
