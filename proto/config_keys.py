"""All keys of the configuration with default, unit and meaning, read from `proto.config`."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Final, get_args

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from proto.config import Config

_UNITS: Final = (
    ("_period_s", "s"),
    ("lease_s", "s"),
    ("_deg", "degrees"),
    ("_steps", "control steps"),
    ("tau", "control steps"),
    ("epochs", "epochs"),
    ("gib", "GiB"),
    ("image_shift", "pixels"),
    ("kernel", "pixels"),
    ("stride", "pixels"),
)
"""How names of keys end, and the unit of their values."""


@dataclass(frozen=True)
class ConfigKey:
    """A key of the configuration, or a section.

    Attributes:
        name: the whole name, such as `learner.rate`; keys in a list have `[]` in it.
        default: value if the key is not given; None is a value too.
        required: whether the key must be given.
        unit: unit of the value; empty if it has none.
        meaning: what it means, in a sentence or two.
        section: whether other keys are in it, so that it has no value itself.
    """

    name: str
    default: Any
    required: bool
    unit: str
    meaning: str
    section: bool = False


def config_keys() -> list[ConfigKey]:
    """Return all sections and keys in the order of `proto.config.Config`."""
    return list(_keys_of(Config, "", Config()))


def _keys_of(
    section: type[BaseModel], prefix: str, defaults: BaseModel | None
) -> Iterator[ConfigKey]:
    """Yield the keys of a section.

    Args:
        section: its class.
        prefix: what stands before its names.
        defaults: a section with all defaults; None if a key of it is required.
    """
    meanings = _meanings(section)
    for name, field in section.model_fields.items():
        kind = field.annotation
        default = field.get_default(call_default_factory=True)
        if defaults is not None:
            default = getattr(defaults, name)
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            meaning = meanings.get(name) or _first_paragraph(kind)
            yield ConfigKey(f"{prefix}{name}", None, False, "", meaning, section=True)
            yield from _keys_of(kind, f"{prefix}{name}.", default)
            continue
        required = default is PydanticUndefined
        meaning = meanings.get(name, "")
        yield ConfigKey(
            f"{prefix}{name}", None if required else _plain(default), required, _unit(name), meaning
        )
        for each in _sections_in(kind):
            yield from _keys_of(each, f"{prefix}{name}[].", None)


def _sections_in(kind: Any) -> Iterator[type[BaseModel]]:
    """Yield the classes of the sections in a list of sections."""
    for part in get_args(kind):
        if isinstance(part, type) and issubclass(part, BaseModel):
            yield part
        elif isinstance(part, UnionType) or get_args(part):
            yield from _sections_in(part)


def _plain(value: Any) -> Any:
    """A value as it stands in YAML."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return str(value) if isinstance(value, Path) else value


def _unit(name: str) -> str:
    return next((unit for ending, unit in _UNITS if name.endswith(ending)), "")


def _meanings(section: type[BaseModel]) -> Mapping[str, str]:
    """Meanings by name from the docstrings of a section's class and of its base classes."""
    found: dict[str, str] = {}
    for base in reversed(section.__mro__):
        if issubclass(base, BaseModel) and base.__doc__:
            found |= _attributes(inspect.cleandoc(base.__doc__))
    return found


def _attributes(docstring: str) -> dict[str, str]:
    """The entries of the part `Attributes:` of a docstring."""
    entries: dict[str, str] = {}
    names: list[str] = []
    _, _, part = docstring.partition("\nAttributes:\n")
    for line in part.splitlines():
        if line and not line.startswith(" "):
            break
        if begins := re.match(r"    (\w+(?:, \w+)*): (.*)", line):
            names = begins[1].split(", ")
            entries |= dict.fromkeys(names, begins[2])
        elif names:
            entries |= {name: f"{entries[name]} {line.strip()}".rstrip() for name in names}
    return entries


def _first_paragraph(section: type[BaseModel]) -> str:
    text = inspect.cleandoc(section.__doc__ or "").partition("\n\n")[0]
    return " ".join(text.split())
