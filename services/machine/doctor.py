"""Checks this machine for problems that prevent a run or slow it down, and advises what to do."""

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
from proto.config import Config, HubConfig, SimulatorConfig
from proto.errors import UserError
from proto.security import (
    certificate_files,
    certificate_folder,
    certificate_of,
    check_link,
    is_loopback,
)
from services.machine.ports import port_trouble

LOCK: Final = Path(__file__).parents[2] / "deploy" / "requirements.lock"
"""File of the locked packages; it exists in a checkout, but not in an installed wheel."""
DISTRIBUTION: Final = "vmdnn"
"""Name under which this project is installed."""

PYTHONS: Final = ((3, 11), (3, 12))
"""Python versions that the lock is made for."""

CORES: Final = 2
"""Least number of usable processor cores for a run."""
MEMORY_GB: Final = 3.0
"""Least available memory for a run."""
DISK_GB: Final = 5.0
"""Least free disk space for a run."""


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes:
        check: subject of the check.
        found: the state that was found.
        advice: what to do; empty if there is no problem.
    """

    check: str
    found: str
    advice: str = ""

    @property
    def ok(self) -> bool:
        """Whether there is no problem."""
        return not self.advice


def examine(config: Config) -> Iterator[Finding]:
    """Check everything that a run with this configuration needs, fast checks first."""
    yield check_python()
    yield check_locked_packages(LOCK) if LOCK.exists() else check_required_packages(DISTRIBUTION)
    yield check_cores(len(os.sched_getaffinity(0)))
    yield check_memory(_available_memory_gb())
    yield check_disk(config.run.folder)
    yield check_port(config.hub.endpoint)
    yield check_security(config.hub)
    yield check_kernel()
    yield check_graphics(config.simulator)


def check_python() -> Finding:
    """Check that the lock is made for this version of Python."""
    found = f"Python {sys.version.split()[0]}"
    if sys.version_info[:2] in PYTHONS:
        return Finding("python", found)
    return Finding("python", found, "make .venv with Python 3.11 or 3.12")


def check_locked_packages(lock: Path) -> Finding:
    """Check that every locked package is installed in the locked version.

    Packages of extras may be missing.
    """
    extras = read_lock(lock, extras=True)
    locked = read_lock(lock) | {name: extras[name] for name in extras if _installed(name)}
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
    """Check that the requirements of an installed distribution are installed, in right versions."""
    try:
        required = _requirements(distribution)
    except PackageNotFoundError:
        return Finding(
            "packages",
            f"{distribution} is not installed, so its requirements are unknown",
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
    """Check that there is memory for the learner, one actor and the services."""
    found = f"{available_gb:.1f} GB available"
    if available_gb >= MEMORY_GB:
        return Finding("memory", found)
    return Finding("memory", found, f"free memory: a small run needs about {MEMORY_GB:.0f} GB")


def check_disk(folder: Path) -> Finding:
    """Check that there is disk space for a run's recordings."""
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


def check_security(config: HubConfig) -> Finding:
    """Check who can connect to the hub, and the certificates that this machine has."""
    try:
        check_link(config)
        if config.security == "none":
            who = "only processes of this machine can connect to the hub"
            if not is_loopback(config.endpoint):
                who = "hub.insecure: everyone who can reach the hub may stop and change the run"
            return Finding("security", who)
        folder = certificate_folder(config)
        held = [certificate_of(folder, file.stem) for file in certificate_files(folder)]
    except UserError as error:
        return Finding("security", "the hub cannot be used like this", str(error))
    if not held:
        return Finding(
            "security", f"there is no certificate in {folder}", "make some: deploy/certificates.sh"
        )
    first = min(held, key=lambda certificate: certificate.expires)
    found = f"{len(held)} certificates in {folder}, valid until {first.expires:%Y-%m-%d}"
    return Finding("security", found, first.expiry_words if first.expires_soon else "")


def check_kernel() -> Finding:
    """Check that the C++ kernels can be compiled for this machine; compile them if need be."""
    try:
        return Finding("kernel", f"compiled: {find_or_compile()}")
    except NotCompiledError as error:
        return Finding(
            "kernel",
            f"not compiled: {error}",
            "training works without it, but slower; as root: apt-get install g++",
        )


def check_graphics(config: SimulatorConfig) -> Finding:
    """Check that the backend of the configuration can render, if the configuration renders."""
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


def read_lock(lock: Path, *, extras: bool = False) -> dict[str, str]:
    """Read the version of each locked package by name.

    Args:
        lock: the file.
        extras: read the packages that only an extra needs, instead of all others.
    """
    lines = (line.partition("#")[0].strip() for line in lock.read_text().splitlines())
    packages = (line.partition(";") for line in lines if line)
    pairs = (text.strip().partition("==") for text, _, extra in packages if bool(extra) == extras)
    return {name: wanted for name, _, wanted in pairs}


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _requirements(distribution: str) -> list[Requirement]:
    """Return the requirements of a distribution on this machine, without its extras."""
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
