"""A user's class is found by its name, and problems with it are reported."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from proto.errors import UserError
from proto.extensions import check_attributes, load_class

BUILT_IN = {"plain": "collections:Counter", "other": "collections:OrderedDict"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The current folder, which Python does not search yet."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def load(name: str, *required: str) -> type:
    return load_class("simulator.backend", name, BUILT_IN, required)


def test_a_built_in_class_has_a_short_name() -> None:
    assert load("plain", "most_common").__name__ == "Counter"


def test_a_class_in_the_current_folder_is_found(folder: Path) -> None:
    (folder / "package").mkdir()
    (folder / "package" / "module.py").write_text("class Mine:\n    def play(self): ...\n")
    assert load("package.module:Mine", "play").__name__ == "Mine"


def test_the_current_folder_hides_no_installed_module(folder: Path) -> None:
    (folder / "proto.py").write_text("raise RuntimeError\n")
    (folder / "mine.py").write_text("import proto.body\nclass Mine: ...\n")
    assert load("mine:Mine").__name__ == "Mine"


@pytest.mark.parametrize("name", ["plane", "", ":Class", "module:", ".module:Class", "a b:Class"])
def test_an_invalid_name_is_refused_with_a_list_of_built_in_names(name: str) -> None:
    with pytest.raises(UserError, match=r"simulator\.backend: there is no .*other, plain.*:Class"):
        load(name)


@pytest.mark.parametrize("name", ["no.such.module:Mine", "email.nothing:Mine"])
def test_a_module_that_does_not_exist_cannot_be_found(name: str) -> None:
    with pytest.raises(UserError, match=f"{name}' cannot be found: No module.*other, plain"):
        load(name)


@pytest.mark.parametrize("name", ["collections:Nothing", "collections:abc"])
def test_a_module_without_the_class_is_named(name: str) -> None:
    with pytest.raises(UserError, match=r"collections/__init__\.py defines no class"):
        load(name)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("\nimport no_such_library\n", "line 2: ModuleNotFoundError: No module named 'no_such"),
        ("1 / 0\n", "line 1: ZeroDivisionError"),
        ("class Mine\n", "SyntaxError: expected ':' (broken.py, line 1)"),
    ],
)
def test_an_error_in_the_import_of_a_module_is_reported(
    folder: Path, text: str, message: str
) -> None:
    (folder / "broken.py").write_text(text)
    with pytest.raises(UserError, match="importing it failed") as caught:
        load("broken:Mine")
    assert message in str(caught.value)
    assert "broken.py" in str(caught.value)
    assert "cannot be found" not in str(caught.value)


def test_an_incomplete_class_is_refused_with_its_missing_methods(folder: Path) -> None:
    (folder / "half.py").write_text(
        "from abc import abstractmethod\n"
        "from typing import Protocol\n"
        "class Contract(Protocol):\n"
        "    @abstractmethod\n"
        "    def inherited(self): ...\n"
        "class Half(Contract):\n"
        "    def given(self): ...\n"
    )
    with pytest.raises(UserError, match=re.escape("lacks: absent, inherited.")):
        load("half:Half", "given", "inherited", "absent")


def test_an_object_without_its_attributes_is_refused() -> None:
    with pytest.raises(UserError, match=r"'mine' is incomplete; it lacks the attributes: b, c\."):
        check_attributes("task.name", "mine", SimpleNamespace(a=1), ("c", "a", "b"))
