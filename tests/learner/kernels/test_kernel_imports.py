"""Kernels get arrays and return arrays: they import no network, no training and no config."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import learner.kernels

ALLOWED = ("learner.kernels", "proto.errors")
MODULES = sorted(Path(learner.kernels.__path__[0]).glob("*.py"))


def imported(module: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(module.read_text())):
        if isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.stem)
def test_a_kernel_imports_nothing_of_ours_but_kernels_and_errors(module: Path) -> None:
    ours = {
        name
        for name in imported(module)
        if name.split(".")[0] in ("learner", "proto", "actors", "services")
    }
    assert {name for name in ours if not name.startswith(ALLOWED)} == set()
