"""A class of one's own is found by name, and what is missing in it is told."""

from __future__ import annotations

from pathlib import Path

import pytest

from proto.errors import UserError
from proto.extensions import load_class

BUILT_IN = {"leases": "proto.leases:Leases"}


def load(name: str, needed: tuple[str, ...] = ("take",)) -> type:
    return load_class("thing.name", name, BUILT_IN, needed)


def test_built_in_and_other_classes_are_found() -> None:
    assert load("leases") is load("proto.leases:Leases")


def test_a_class_in_the_current_folder_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_things.py").write_text("class Own:\n    def take(self): ...\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", ["/nowhere"])
    assert load("own_things:Own").__name__ == "Own"


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        (
            "lease",
            r"thing.name: there is no 'lease'. Built in are: leases; .*module:Class",
        ),
        ("no_such.module:Own", "there is no module 'no_such'"),
        ("proto.leases:Lease", "proto.leases has no 'Lease'"),
        ("proto.leases:Item", "is no class"),
        ("broken_things:Own", "broken_things fails while it is imported: ZeroDivisionError"),
        ("needy_things:Own", "needy_things needs the module 'not_installed'"),
    ],
)
def test_what_is_wrong_is_named(
    name: str, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_things.py").write_text("1 / 0\n")
    (tmp_path / "needy_things.py").write_text("import not_installed\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(UserError, match=problem):
        load(name)


def test_what_a_class_lacks_is_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "poor_things.py").write_text(
        "from abc import ABC, abstractmethod\n"
        "class Own(ABC):\n"
        "    declared: int\n"
        "    @abstractmethod\n"
        "    def give(self): ...\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(UserError, match="lacks give, take; needed are declared, give, take"):
        load("poor_things:Own", ("declared", "give", "take"))
