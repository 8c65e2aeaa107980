"""README.md and docs/ name only files, settings and commands that exist."""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from actors.tasks.registry import TASKS
from proto.config import Config, load_config
from services.cli import COMMANDS

ROOT = Path(__file__).parents[1]
DOCUMENTS = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
CHANGELOG = ROOT / "CHANGELOG.md"
"""It also names what is gone, so only its links are tested."""
PACKAGES = ("proto", "sim_assets", "learner", "actors", "services", "deploy")
FOLDERS = (*PACKAGES, "docs", "tests")
FIRST_WORDS = {*Config.model_fields, *PACKAGES} - {"task"}
"""How settings and modules begin; `task.x` is also an attribute in Python."""

each_document = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda document: document.stem)


def in_backticks(text: str) -> list[str]:
    """What stands in backticks, outside code blocks."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))


def anchors(text: str) -> set[str]:
    """Names under which the headings of a document can be linked, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def settings(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """All keys of a configuration, sections included, such as `learner` and `learner.rate`."""
    for name, value in values.items():
        yield f"{prefix}{name}"
        if isinstance(value, Mapping):
            yield from settings(value, f"{prefix}{name}.")


def known_settings() -> set[str]:
    """Keys of the configuration and options of the built-in tasks."""
    classes = map(pkgutil.resolve_name, TASKS.values())
    options = {f"task.{option}" for each in classes for option in each.options}
    return {*settings(load_config(None).model_dump()), *options}


def is_importable(name: str) -> bool:
    """Whether a dotted name is a module of ours, or something in one."""
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


def code(text: str) -> str:
    """The code blocks: those between fences, and lines that are indented by four spaces."""
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    return "\n".join([*fenced, *re.findall(r"^    .*$", text, flags=re.MULTILINE)])


def commands(text: str) -> Iterator[list[str]]:
    """The words of each `vmdnn` command in the code blocks; what the shell fills in stands as X."""
    lines = re.sub(r"\\\n\s*", "", code(text))
    for line in re.findall(r"^ *(?:[A-Z_]+=\S+ )?(vmdnn .*)$", lines, flags=re.MULTILINE):
        filled = re.sub(r"\$\([^)]*\)", "X", line)
        yield shlex.split(filled, comments=True)[1:]


def parser_of(command: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=f"vmdnn {command}")
    module, _ = COMMANDS[command]
    importlib.import_module(module).configure(parser)
    return parser


@pytest.mark.parametrize("document", [*DOCUMENTS, CHANGELOG], ids=lambda document: document.stem)
def test_every_relative_link_leads_somewhere(document: Path) -> None:
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
        if link.startswith(("https://", "http://", "mailto:")):
            continue
        path, _, anchor = link.partition("#")
        target = document.parent / path if path else document
        if not target.exists() or (anchor and anchor not in anchors(target.read_text())):
            broken.append(link)
    assert broken == []


@each_document
def test_every_path_in_backticks_exists(document: Path) -> None:
    """Paths from the root: source files, and whatever lies in one of our folders."""
    words = in_backticks(document.read_text())
    paths = [word for word in words if re.fullmatch(r"[\w.\-]+(?:/[\w.\-]+)*/?", word)]
    ours = [
        path
        for path in paths
        if "/" in path and (path.partition("/")[0] in FOLDERS or path.endswith(".py"))
    ]
    assert [path for path in ours if not (ROOT / path).exists()] == []


@each_document
def test_every_dotted_name_in_backticks_is_a_module_or_a_setting(document: Path) -> None:
    words = in_backticks(document.read_text())
    names = [word for word in words if re.fullmatch(r"\w+(?:\.\w+)+(?:=\S+)?", word)]
    ours = {
        name.partition("=")[0]
        for name in names
        if name.partition(".")[0] in FIRST_WORDS and not name.endswith((".py", ".crt", ".key"))
    }
    known = known_settings()
    assert [name for name in sorted(ours) if name not in known and not is_importable(name)] == []


def test_every_room_of_the_architecture_exists() -> None:
    """A row of the table names a folder in bold, or files and folders of the one named last."""
    (table,) = re.findall(
        r"\| room \|.*?\n\n", (ROOT / "docs" / "architecture.md").read_text(), flags=re.DOTALL
    )
    folder, missing = ROOT, []
    for row in table.strip().splitlines()[2:]:
        named = row.split("|")[1]
        if bold := re.search(r"\*\*\[(\w+)/\]", named):
            folder = ROOT / bold[1]
        missing += [name for name in in_backticks(named) if not (folder / name).exists()]
    assert missing == []


@each_document
def test_every_setting_on_a_command_line_exists(document: Path) -> None:
    named = re.findall(r"--set ([\w.]+)=", document.read_text())
    assert [name for name in named if name not in known_settings()] == []


@each_document
def test_every_vmdnn_command_is_accepted(document: Path) -> None:
    """Its words are parsed, not run."""
    for words in commands(document.read_text()):
        try:
            parser_of(words[0]).parse_args(words[1:])
        except SystemExit:
            pytest.fail(f"vmdnn {shlex.join(words)}")
