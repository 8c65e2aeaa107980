"""Checks this machine: what prevents a run or slows it down, and what to do about it."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Final

from packaging.requirements import Requirement

from actors.simulator import load_backend
from learner.kernels.build import NotCompiledError, find_or_compile
from proto.config import Config, SimulatorConfig
from proto.errors import UserError
from services.machine.ports import port_trouble

LOCK: Final = Path(__file__).parents[2] / "deploy" / "requirements.lock"
"""The locked packages. Only a checkout has this file; an installed wheel does not."""
DISTRIBUTION: Final = "vmdnn"
"""Name under which this project is installed."""

PYTHONS: Final = ((3, 11), (3, 12))
"""The Pythons for which the lock was made."""

CORES: Final = 2
"""Usable processor cores that a run needs at least."""
MEMORY_GB: Final = 3.0
"""Available memory that a run needs at least."""
DISK_GB: Final = 5.0
"""Free disk space that a run needs at least."""


@dataclass(frozen=True)
class Finding:
    """What one check found.

    Attributes:
        check: what was checked.
        found: what was found.
        advice: what to do about it; empty if there is no problem.
    """

    check: str
    found: str
    advice: str = ""

    @property
    def ok(self) -> bool:
        """Whether there is no problem."""
        return not self.advice


def examine(config: Config) -> Iterator[Finding]:
    """Check everything that a run with this configuration needs, quickest checks first."""
    yield check_python()
    yield check_locked_packages(LOCK) if LOCK.exists() else check_required_packages(DISTRIBUTION)
    yield check_cores(len(os.sched_getaffinity(0)))
    yield check_memory(_available_memory_gb())
    yield check_disk(config.run.folder)
    yield check_port(config.hub.endpoint)
    yield check_kernel()
    yield check_graphics(config.simulator)


def check_python() -> Finding:
    """Check that this Python is one for which the lock was made."""
    found = f"Python {sys.version.split()[0]}"
    if sys.version_info[:2] in PYTHONS:
        return Finding("python", found)
    return Finding("python", found, "make .venv with Python 3.11 or 3.12")


def check_locked_packages(lock: Path) -> Finding:
    """Check that every locked package is installed in the locked version."""
    locked = read_lock(lock)
    differing = [
        f"{name} {installed or 'missing'} instead of {wanted}"
        for name, wanted in locked.items()
        if (installed := _installed(name)) is None or installed.partition("+")[0] != wanted
    ]
    install = f"{sys.executable} -m pip install --no-deps --force-reinstall"
    if differing:
        return Finding("packages", "; ".join(differing), f"{install} -r {lock}")
    if _installed("opencv-python") is not None:
        return Finding(
            "packages",
            "opencv-python, which overwrites files of opencv-python-headless",
            f"{sys.executable} -m pip uninstall opencv-python, then "
            f"{install} opencv-python-headless=={locked['opencv-python-headless']}",
        )
    return Finding("packages", f"{len(locked)} as locked")


def check_required_packages(distribution: str) -> Finding:
    """Check that what an installed distribution requires is installed, in versions that fit."""
    try:
        required = _requirements(distribution)
    except PackageNotFoundError:
        return Finding(
            "packages",
            f"{distribution} is not installed, so what it requires is unknown",
            f"install {distribution}'s wheel with pip, or run from a checkout of the repository",
        )
    if unmet := [requirement for requirement in required if not _is_met(requirement)]:
        found = (f"{one} ({_installed(one.name) or 'missing'})" for one in unmet)
        wanted = " ".join(f"'{one}'" for one in unmet)
        return Finding("packages", ", ".join(found), f"{sys.executable} -m pip install {wanted}")
    return Finding("packages", f"{len(required)} as {distribution} requires")


def check_cores(cores: int) -> Finding:
    """Check that there is a core for the learner and one for an actor."""
    found = f"{cores} usable"
    if cores >= CORES:
        return Finding("cores", found)
    return Finding("cores", found, "learner and actor will share a core: expect half the speed")


def check_memory(available_gb: float) -> Finding:
    """Check that learner, one actor and the services fit into memory."""
    found = f"{available_gb:.1f} GB available"
    if available_gb >= MEMORY_GB:
        return Finding("memory", found)
    return Finding("memory", found, f"free some: a small run needs about {MEMORY_GB:.0f} GB")


def check_disk(folder: Path) -> Finding:
    """Check that there is room for a run's recordings."""
    places = (folder.resolve(), *folder.resolve().parents)
    existing = next(place for place in places if place.exists())
    free_gb = shutil.disk_usage(existing).free / 1e9
    found = f"{free_gb:.1f} GB free at {existing}"
    if free_gb >= DISK_GB:
        return Finding("disk", found)
    return Finding(
        "disk", found, f"free {DISK_GB:.0f} GB, or put runs elsewhere: --set run.folder=DIR"
    )


def check_port(endpoint: str) -> Finding:
    """Check that the hub can listen on its endpoint."""
    if trouble := port_trouble(endpoint):
        return Finding("hub port", endpoint, trouble)
    return Finding("hub port", f"{endpoint} is free")


def check_kernel() -> Finding:
    """Check that the C++ kernels are or can be compiled for this machine's processor."""
    try:
        return Finding("kernel", f"compiled: {find_or_compile()}")
    except NotCompiledError as error:
        return Finding(
            "kernel",
            f"not compiled: {error}",
            "training works without it, but slower; as root: apt-get install g++",
        )


def check_graphics(config: SimulatorConfig) -> Finding:
    """Check that the chosen backend can render, if pictures are wanted."""
    if not config.render:
        return Finding("graphics", "not needed: simulator.render is false")
    try:
        diagnosis = load_backend(config.backend).diagnose()
    except UserError as error:
        return Finding(
            "graphics", str(error), "fix it, or choose another: --set simulator.backend=NAME"
        )
    if diagnosis.works:
        return Finding("graphics", diagnosis.found)
    return Finding("graphics", diagnosis.found, diagnosis.cure or "the backend names no cure")


def read_lock(lock: Path) -> dict[str, str]:
    """Version of each locked package by name."""
    lines = (line.partition("#")[0].strip() for line in lock.read_text().splitlines())
    pairs = (line.partition("==") for line in lines if line)
    return {name: wanted for name, _, wanted in pairs}


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _requirements(distribution: str) -> list[Requirement]:
    """What a distribution requires on this machine, without its extras."""
    requirements = map(Requirement, requires(distribution) or ())
    return [one for one in requirements if one.marker is None or one.marker.evaluate({"extra": ""})]


def _is_met(requirement: Requirement) -> bool:
    installed = _installed(requirement.name)
    return installed is not None and requirement.specifier.contains(installed, prereleases=True)


def _available_memory_gb() -> float:
    for line in Path("/proc/meminfo").read_text().splitlines():
        name, _, amount = line.partition(":")
        if name == "MemAvailable":
            return int(amount.split()[0]) * 1024 / 1e9
    return 0.0
