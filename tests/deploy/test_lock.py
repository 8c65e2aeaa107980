"""The lock is complete: it contains every package that a fresh machine needs."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from services.machine.doctor import LOCK, read_lock

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
EXTRAS = read_lock(LOCK, extras=True)
LOCKED = read_lock(LOCK) | EXTRAS
OPTIONAL = PROJECT["optional-dependencies"]
REPLACED = {"opencv-python"}
"""Required by sapien, and provided by opencv-python-headless."""


def wanted_by(package: str) -> list[Requirement]:
    found = map(Requirement, requires(package) or [])
    wanted = [r for r in found if r.marker is None or r.marker.evaluate({"extra": ""})]
    # What builds of torch for other machines ask for besides is not locked.
    return [r for r in wanted if package != "torch" or canonicalize_name(r.name) in LOCKED]


def test_names_are_canonical_and_sorted() -> None:
    lines = LOCK.read_text().splitlines()
    names = [line.partition("==")[0] for line in lines if line and not line.startswith("#")]
    assert names == sorted(map(canonicalize_name, names))
    assert sorted(LOCKED) == names


def test_every_requirement_is_locked_in_a_version_that_fits() -> None:
    asked = [
        *map(Requirement, PROJECT["dependencies"]),
        *(Requirement(line) for extra in OPTIONAL.values() for line in extra),
        *(requirement for package in LOCKED for requirement in wanted_by(package)),
    ]
    for requirement in asked:
        name = canonicalize_name(requirement.name)
        if name not in REPLACED:
            assert name in LOCKED, f"{requirement} is not locked"
            assert Version(LOCKED[name]) in requirement.specifier, requirement


def test_every_locked_package_is_required() -> None:
    always = closure(PROJECT["dependencies"] + OPTIONAL["dev"]) | {"setuptools"}  # which builds
    assert set(LOCKED) - set(EXTRAS) == always


def test_the_packages_of_an_extra_are_marked() -> None:
    assert set(EXTRAS) == closure(OPTIONAL["mujoco"]) - (set(LOCKED) - set(EXTRAS))
    marked = re.findall(r"^(\S+)==\S+ ; extra == \"mujoco\"$", LOCK.read_text(), re.MULTILINE)
    assert marked == list(EXTRAS)


def closure(project: list[str]) -> set[str]:
    """Names of the packages that requirements ask for, and of those that these ask for."""
    needed: set[str] = set()
    waiting = [canonicalize_name(Requirement(line).name) for line in project]
    while waiting:
        name = waiting.pop()
        if name not in needed and name not in REPLACED:
            needed.add(name)
            waiting += [canonicalize_name(r.name) for r in wanted_by(name)]
    return needed
