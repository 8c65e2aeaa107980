"""`vmdnn config`: all keys of the configuration with default, unit and meaning."""

from __future__ import annotations

import argparse
import json
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any, Final

from proto.config import Config
from proto.config_keys import ConfigKey, config_keys
from proto.errors import UserError
from proto.strict_yaml import dump_yaml
from services.arguments.common import add_config, config_of

_WIDTH: Final = 100
_HEAD: Final = """# Configuration

Every key of the configuration: its default, its unit and what it means. `vmdnn config --markdown`
writes this page from the code; `vmdnn config --config NAME` prints the values of a configuration.
A key is set in a YAML file, as `rate` below `learner`, or on the command line
(`--set learner.rate=1e-3`). `null` means that a key is not set. The options of tasks are in the
section `task`, too; [experiment1.md](experiment1.md) and [experiment2.md](experiment2.md) describe
them.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_config(parser)
    parser.add_argument(
        "--only", default="", metavar="TEXT", help="only keys with this text, such as learner."
    )
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print JSON")
    form.add_argument(
        "--markdown", action="store_true", help="print the page docs/config.md, with the defaults"
    )


def run(arguments: argparse.Namespace) -> int:
    """Print the keys."""
    config = config_of(arguments)
    if arguments.markdown:
        print(markdown(), end="")
        return 0
    keys = [key for key in config_keys() if arguments.only in key.name]
    if not keys:
        raise UserError(f"no key contains {arguments.only!r}; `vmdnn config` lists all keys")
    if arguments.json:
        print(json.dumps([asdict(key) | {"value": _value(key, config)} for key in keys], indent=2))
        return 0
    for key in keys:
        for line in _lines(key, config):
            print(line)
    return 0


def markdown() -> str:
    """Return the page docs/config.md."""
    return "\n".join([_HEAD, *_tables(config_keys())])


def _lines(key: ConfigKey, config: Config) -> Iterator[str]:
    """Yield the lines of a key: name, value and unit; then what it means."""
    if key.section:
        yield ""
        yield f"# {key.name}: {_meaning(key)}"
        return
    value = _value(key, config)
    told = "(required)" if key.required else _yaml(value)
    unit = f" {key.unit}" if key.unit and value is not None else ""
    default = "" if key.required or value == key.default else f"   (default {_yaml(key.default)})"
    yield f"{key.name}: {told}{unit}{default}"
    yield from textwrap.wrap(_meaning(key), _WIDTH, initial_indent="    ", subsequent_indent="    ")


def _value(key: ConfigKey, config: Config) -> Any:
    """The value of a key in a configuration; of keys in lists the default."""
    if key.section or "[]" in key.name:
        return key.default
    value: Any = config.model_dump(mode="json")
    for part in key.name.split("."):
        value = value[part]
    return value


def _tables(keys: Sequence[ConfigKey]) -> Iterator[str]:
    """Yield the lines of a heading and a table for each section."""
    for key in keys:
        if key.section:
            yield f"## {key.name}"
            yield ""
            yield _sentence(_meaning(key))
            yield ""
            named = [each for each in keys if not each.section and _section_of(each) == key.name]
            if named:
                yield from ("| key | default | unit | meaning |", "|---|---|---|---|")
                yield from map(_row, named)
                yield ""


def _section_of(key: ConfigKey) -> str:
    """The section in whose table a key stands; those of lists stand with the list."""
    return key.name.partition("[]")[0].rpartition(".")[0]


def _row(key: ConfigKey) -> str:
    default = "required" if key.required else f"`{_yaml(key.default)}`"
    return f"| `{key.name}` | {default} | {key.unit} | {_meaning(key)} |"


def _meaning(key: ConfigKey) -> str:
    """What a key means, in the words of YAML and without the unit, which stands beside it."""
    text = key.meaning.replace("None", "null")
    for unit in ("(s)", "(degrees)", "(control steps)", "(pixels)", "(GiB)"):
        text = text.replace(f" {unit}", "")
    return text


def _sentence(text: str) -> str:
    return text if text.endswith(".") else f"{text}."


def _yaml(value: Any) -> str:
    """A value in one line of YAML."""
    if isinstance(value, list | dict):
        return json.dumps(value)
    return dump_yaml(value).removesuffix("\n...\n").strip()
