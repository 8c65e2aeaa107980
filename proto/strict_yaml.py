"""YAML as its version 1.2 reads it (the core schema), with duplicate keys refused.

PyYAML implements YAML 1.1, in which `no` is false, `010` is eight and `12:30:45` is a number. Here
they are the text `no`, the number ten and the text `12:30:45`; `1e-3` is a number.

A document is limited in length, depth and number of values before anything is made of it. Aliases
count as what they stand for: nine lines of them can stand for millions of values.
"""

from __future__ import annotations

import re
from typing import Any, Final

import yaml

from proto.plain_text import plain

_PREFIX: Final = "tag:yaml.org,2002:"
_INTEGER: Final = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT: Final = re.compile(
    r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
)
LONGEST: Final = 256 * 1024
"""Characters of a document."""
MOST_VALUES: Final = 10_000
"""Values in a document: texts, numbers, lists and sections, keys included."""
DEEPEST: Final = 50
"""Sections and lists inside each other."""
_LONGEST_NUMBER: Final = 100
_BROKEN: Final = (
    ValueError,
    TypeError,
    AttributeError,
    LookupError,
    ArithmeticError,
    RecursionError,
)
"""What PyYAML raises, besides its own errors, for values with tags such as `!!timestamp`."""

_RESOLVERS: Final = {
    "null": re.compile(r"~|null|Null|NULL|"),
    "bool": re.compile(r"true|True|TRUE|false|False|FALSE"),
    "int": _INTEGER,
    "float": _FLOAT,
}


class WrittenInt(int):
    """An integer that remembers how it was written, such as `007`."""

    text: str


class WrittenFloat(float):
    """A number that remembers how it was written, such as `1e3`."""

    text: str


def load_yaml(text: str) -> Any:
    """Read one YAML document; numbers are `WrittenInt` and `WrittenFloat`.

    Raises:
        yaml.YAMLError: it is not YAML, a key stands twice in a map, or it is too large; the message
            has the lines.
    """
    if len(text) > LONGEST:
        raise yaml.YAMLError(f"it is longer than {LONGEST} characters")
    try:
        return yaml.load(text, _Loader)
    except _BROKEN as error:
        raise yaml.YAMLError(f"a value is not valid: {plain(error, 200)}") from error


def dump_yaml(value: Any) -> str:
    """Write a value so that `load_yaml` and readers of YAML 1.1 read the same; keys in order."""
    text: str = yaml.dump(value, Dumper=_Dumper, sort_keys=False)
    return text


class _Dumper(yaml.SafeDumper):
    pass


def _represent_text(dumper: _Dumper, text: str) -> yaml.ScalarNode:
    ambiguous = any(pattern.fullmatch(text) for pattern in _RESOLVERS.values())
    return dumper.represent_scalar(f"{_PREFIX}str", text, style="'" if ambiguous else None)


_Dumper.add_representer(str, _represent_text)


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._values = 0
        self._depth = 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Read a value with all that is in it; refuse it when the document becomes too large."""
        line = self.peek_event().start_mark.line + 1  # type: ignore[no-untyped-call]
        is_alias = self.check_event(yaml.AliasEvent)
        before = self._values
        self._values += 1
        self._depth += 1
        if self._depth > DEEPEST:
            raise yaml.YAMLError(f"line {line}: it is nested deeper than {DEEPEST}")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if is_alias:
            if id(node) not in self._sizes:
                raise yaml.YAMLError(f"line {line}: a value contains itself")
            self._values += self._sizes[id(node)]
        if self._values > MOST_VALUES:
            raise yaml.YAMLError(f"line {line}: it has more than {MOST_VALUES} values")
        self._sizes.setdefault(id(node), self._values - before)
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Make a dict; refuse a key that stands twice."""
        first_lines: dict[Any, int] = {}
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            line = key_node.start_mark.line + 1
            if not isinstance(key, str | int | float | None):
                raise yaml.YAMLError(f"line {line}: a key must be a name")
            if key in first_lines:
                raise yaml.YAMLError(
                    f"the key {plain(repr(key), 100)} stands twice in the same section, in line "
                    f"{first_lines[key]} and in line {line}: remove one of them"
                )
            first_lines[key] = line
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


def _construct_int(loader: _Loader, node: yaml.ScalarNode) -> int:
    text = str(loader.construct_scalar(node))
    if len(text) > _LONGEST_NUMBER or _INTEGER.fullmatch(text) is None:
        raise yaml.YAMLError(f"{_where(node)} is not an integer")
    bases = {"0o": 8, "0x": 16}
    number = WrittenInt(text, bases.get(text[:2], 10))
    number.text = text
    return number


def _construct_float(loader: _Loader, node: yaml.ScalarNode) -> float:
    text = str(loader.construct_scalar(node))
    if len(text) > _LONGEST_NUMBER or _FLOAT.fullmatch(text) is None:
        raise yaml.YAMLError(f"{_where(node)} is not a number")
    number = WrittenFloat(re.sub(r"\.(inf|nan)", r"\1", text.lower()))
    number.text = text
    return number


def _construct_bool(loader: _Loader, node: yaml.ScalarNode) -> bool:
    text = str(loader.construct_scalar(node)).lower()
    if text not in ("true", "false"):
        raise yaml.YAMLError(f"{_where(node)} is not true or false")
    return text == "true"


def _where(node: yaml.ScalarNode) -> str:
    return f"line {node.start_mark.line + 1}: {plain(repr(node.value), 100)}"


for _name, _pattern in _RESOLVERS.items():
    _Loader.add_implicit_resolver(f"{_PREFIX}{_name}", re.compile(f"(?:{_pattern.pattern})$"), None)
_Loader.add_constructor(f"{_PREFIX}int", _construct_int)
_Loader.add_constructor(f"{_PREFIX}float", _construct_float)
_Loader.add_constructor(f"{_PREFIX}bool", _construct_bool)
