"""Whether SAPIEN can render on this machine, and what to install if not."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from actors.backends.probing import ProbeError, answer_of
from actors.simulator import OTHER_SYSTEM, Diagnosis
from proto.errors import UserError

CURE: Final = """\
SAPIEN renders with Vulkan, also without a GPU. What provides it (as root):
  Debian 12, no NVIDIA card: Mesa 24.3 or newer, which is in bookworm-backports:
    apt-get install -t bookworm-backports mesa-vulkan-drivers libvulkan1
  Ubuntu 24.04, no NVIDIA card: Mesa 24.3 or newer, which is in noble-updates:
    apt-get update && apt-get install mesa-vulkan-drivers libvulkan1
  NVIDIA card: the driver's own Vulkan, of the same version as the kernel module (`nvidia-smi`):
    apt-get install libnvidia-gl-VERSION libvulkan1 (Debian: nvidia-vulkan-icd)
Runs that need no pictures go without it: --set simulator.render=false"""
_MESA: Final = ("mesa-vulkan-drivers", "libvulkan1")
PACKAGES: Final[Mapping[str, tuple[str, ...]]] = {
    "debian-12": ("-t", "bookworm-backports", *_MESA),  # Debian 12 itself has Mesa 22.3
    OTHER_SYSTEM: _MESA,
}
"""Packages of a driver that has VK_KHR_external_semaphore_fd: Mesa's, from 24.3 on."""


def diagnose() -> Diagnosis:
    """Render a picture in another process and say how that went; takes about a second."""
    try:
        answer = answer_of(Path(__file__).with_name("probe.py"))
    except ProbeError as error:
        return _failed(str(error))
    if answer["problem"]:
        return _failed(_driver_problem(answer["problem"], answer["known"]))
    return Diagnosis(True, f"SAPIEN renders on {answer['device']}")


@functools.cache
def require_graphics() -> None:
    """Check that SAPIEN can render; in each process, a success is checked only once.

    Raises:
        UserError: SAPIEN cannot render; the message says what to install. The next call checks
            again.
    """
    diagnosis = diagnose()
    if not diagnosis.works:
        raise UserError(diagnosis.text())


def _failed(problem: str) -> Diagnosis:
    return Diagnosis(False, f"SAPIEN cannot render: {problem}", CURE, PACKAGES)


def _driver_problem(problem: str, known: list[tuple[str, str]]) -> str:
    if not known:
        return f"no Vulkan driver was found ({problem})"
    listing = ", ".join(f"{name} by {driver}" for name, driver in known)
    return f"the Vulkan driver is too old or incomplete ({listing}: {problem})"
