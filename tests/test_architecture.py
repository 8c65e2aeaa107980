"""Rules of the whole project: allowed imports, and modules that may write to disk."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAY_IMPORT = {
    "proto": {"proto"},
    "sim_assets": {"sim_assets"},
    "learner": {"learner", "proto"},
    "actors": {"actors", "learner", "proto", "sim_assets"},
    "services": {"services", "actors", "learner", "proto", "sim_assets"},
    "deploy": {"deploy", "services", "actors", "learner", "proto", "sim_assets"},
}
ONLY_IN = {
    "zenoh": "proto/bus.py",
    "sapien": "actors/backends/sapien/",
    "mujoco": "actors/backends/mujoco/",
}
"""Packages that may be imported in one place only."""

MAY_WRITE = {
    "services/playing/video_file.py": "a video in a temporary folder, which storage then copies",
    "services/monitoring/event_file.py": "a video in memory",
    "services/bus_bench.py": "logs of the processes that it measures, in a temporary folder",
    "proto/storage.py": "all writing goes through it",
    "proto/run_locks.py": "an empty file that is locked; nothing is kept in it",
    "sim_assets/icub_visuals.py": "a cache, built in a folder that is renamed when it is complete",
}
WRITERS = {"write_text", "write_bytes", "imwrite", "savez", "savez_compressed", "tofile"}


@dataclass(frozen=True)
class Source:
    """A source file of the project.

    Attributes:
        name: path from the root.
        tree: its syntax tree.
    """

    name: str
    tree: ast.Module

    @property
    def package(self) -> str:
        return self.name.partition("/")[0]

    def imports(self) -> Iterator[str]:
        """Yield every module that is imported, also inside functions."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{self.name}: a relative import"
                yield node.module or ""

    def writes(self) -> Iterator[int]:
        """Yield the lines that open a file for writing, or call a function that writes a file."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Call):
                called = _called(node)
                modes = [_text(argument) for argument in (*node.args, *_keyword(node, "mode"))]
                opens = called == "open" and any(map(_is_writing_mode, modes))
                if opens or called in WRITERS:
                    yield node.lineno


def sources() -> list[Source]:
    files = [file for package in MAY_IMPORT for file in (ROOT / package).rglob("*.py")]
    return [Source(str(f.relative_to(ROOT)), ast.parse(f.read_text())) for f in sorted(files)]


SOURCES = sources()


def _called(node: ast.Call) -> str:
    if isinstance(node.func, ast.Attribute):
        return node.func.attr
    return node.func.id if isinstance(node.func, ast.Name) else ""


def _keyword(node: ast.Call, name: str) -> list[ast.expr]:
    return [keyword.value for keyword in node.keywords if keyword.arg == name]


def _text(node: ast.expr) -> str:
    constant = isinstance(node, ast.Constant) and isinstance(node.value, str)
    return node.value if constant else ""


def _is_writing_mode(mode: str) -> bool:
    return 0 < len(mode) <= 3 and set(mode) <= set("rwxabt+") and bool(set(mode) & set("wxa+"))


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.name)
def test_imports_run_one_way(source: Source) -> None:
    ours = {module.partition(".")[0] for module in source.imports()} & MAY_IMPORT.keys()
    assert ours <= MAY_IMPORT[source.package]


@pytest.mark.parametrize(("package", "place"), ONLY_IN.items())
def test_some_packages_are_imported_in_one_place_only(package: str, place: str) -> None:
    importing = [s.name for s in SOURCES if package in {m.partition(".")[0] for m in s.imports()}]
    assert [name for name in importing if not name.startswith(place)] == []


def test_kernels_import_nothing_else_of_the_learner() -> None:
    """They take and return arrays, and must not depend on network, training or config."""
    foreign = [
        f"{source.name} imports {module}"
        for source in SOURCES
        if source.name.startswith("learner/kernels/")
        for module in source.imports()
        if (module.startswith("learner.") and not module.startswith("learner.kernels"))
        or module == "proto.config"
    ]
    assert foreign == []


def test_only_the_storage_module_writes_to_disk() -> None:
    writing = {source.name for source in SOURCES if any(source.writes())}
    assert writing == set(MAY_WRITE)
