"""Looks over this machine: what stands in the way of a run, and what to do about it."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from actors.backends.sapien.graphics import CURE, diagnose
from learner.kernels.build import NotCompiledError, find_or_compile
from proto.config import Config
from services.machine.ports import port_trouble

LOCK: Final = Path(__file__).parents[2] / "deploy" / "requirements.lock"
"""The locked packages; only a checkout has it."""

PYTHONS: Final = ((3, 11), (3, 12))
"""The Pythons for which the lock was made."""

CORES: Final = 2
MEMORY_GB: Final = 3.0
DISK_GB: Final = 5.0


@dataclass(frozen=True)
class Finding:
    """What one check found.

    Attributes:
        check: what was looked at.
        found: what is there.
        advice: what to do about it; empty where all is well.
    """

    check: str
    found: str
    advice: str = ""

    @property
    def ok(self) -> bool:
        """Whether all is well."""
        return not self.advice


def examine(config: Config) -> Iterator[Finding]:
    """Look at everything that a run with this configuration needs, cheapest first."""
    yield check_python()
    yield check_packages(LOCK)
    yield check_cores(len(os.sched_getaffinity(0)))
    yield check_memory(_available_memory_gb())
    yield check_disk(config.run.folder)
    yield check_port(config.hub.endpoint)
    yield check_kernel()
    yield check_graphics()


def check_python() -> Finding:
    """Python is one of those for which the lock was made."""
    found = f"Python {sys.version.split()[0]}"
    if sys.version_info[:2] in PYTHONS:
        return Finding("python", found)
    return Finding("python", found, "make .venv with Python 3.11 or 3.12")


def check_packages(lock: Path) -> Finding:
    """Every locked package is installed in its version."""
    if not lock.exists():
        return Finding("packages", f"no lock at {lock}", "run from a checkout of the repository")
    locked = read_lock(lock)
    differing = [
        f"{name} {there or 'missing'} instead of {wanted}"
        for name, wanted in locked.items()
        if (there := _installed(name)) is None or there.partition("+")[0] != wanted
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


def check_cores(cores: int) -> Finding:
    """There is a core for the learner and one for an actor."""
    found = f"{cores} usable"
    if cores >= CORES:
        return Finding("cores", found)
    return Finding("cores", found, "learner and actor will share a core: expect half the speed")


def check_memory(available_gb: float) -> Finding:
    """Learner, one actor and the services fit into memory."""
    found = f"{available_gb:.1f} GB available"
    if available_gb >= MEMORY_GB:
        return Finding("memory", found)
    return Finding("memory", found, f"free some: a small run needs about {MEMORY_GB:.0f} GB")


def check_disk(folder: Path) -> Finding:
    """There is room for a run's recordings."""
    there = next(place for place in (folder.resolve(), *folder.resolve().parents) if place.exists())
    free_gb = shutil.disk_usage(there).free / 1e9
    found = f"{free_gb:.1f} GB free at {there}"
    if free_gb >= DISK_GB:
        return Finding("disk", found)
    return Finding(
        "disk", found, f"free {DISK_GB:.0f} GB, or put runs elsewhere: --set run.folder=DIR"
    )


def check_port(endpoint: str) -> Finding:
    """The hub could listen."""
    if trouble := port_trouble(endpoint):
        return Finding("hub port", endpoint, trouble)
    return Finding("hub port", f"{endpoint} is free")


def check_kernel() -> Finding:
    """Training has its kernel, compiled for this machine's processor."""
    try:
        return Finding("kernel", f"compiled: {find_or_compile()}")
    except NotCompiledError as error:
        return Finding(
            "kernel",
            f"not compiled: {error}",
            "training works without it, but slower; as root: apt-get install g++",
        )


def check_graphics() -> Finding:
    """SAPIEN can render."""
    report = diagnose()
    if report.works:
        return Finding("graphics", report.text())
    return Finding("graphics", f"SAPIEN cannot render: {report.problem}", CURE)


def read_lock(lock: Path) -> dict[str, str]:
    """Versions of the locked packages by name."""
    lines = (line.partition("#")[0].strip() for line in lock.read_text().splitlines())
    pairs = (line.partition("==") for line in lines if line)
    return {name: wanted for name, _, wanted in pairs}


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _available_memory_gb() -> float:
    for line in Path("/proc/meminfo").read_text().splitlines():
        name, _, amount = line.partition(":")
        if name == "MemAvailable":
            return int(amount.split()[0]) * 1024 / 1e9
    return 0.0
