"""Whether MuJoCo can render on this machine, with which driver, and what to install if not."""

from __future__ import annotations

import functools
import importlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from actors.backends.probing import ProbeError, answer_of
from actors.simulator import OTHER_SYSTEM, Diagnosis
from proto.errors import UserError

DRIVERS: Final = ("egl", "osmesa")
"""Ways to get OpenGL without a screen, best first. OSMesa never uses a GPU."""
VARIABLE: Final = "MUJOCO_GL"
"""Environment variable with which the user chooses one of them."""
PYOPENGL_VARIABLE: Final = "PYOPENGL_PLATFORM"
"""Environment variable that tells PyOpenGL the driver. MuJoCo sets it when it loads a driver, and
refuses every other one as long as it is set."""
CURE: Final = """\
MuJoCo renders with OpenGL, also without a GPU. What provides it (as root):
  Debian and Ubuntu, no NVIDIA card, by EGL:
    apt-get install libegl1 libopengl0 libgl1-mesa-dri
  NVIDIA card: the driver's own EGL, of the same version as the kernel module (`nvidia-smi`):
    apt-get install libegl1 libopengl0 libnvidia-gl-VERSION (Debian: libegl-nvidia0)
  Debian 12 and Ubuntu 24.04, where EGL does not work, by OSMesa:
    apt-get install libosmesa6
MuJoCo tries EGL, then OSMesa; the environment variable MUJOCO_GL=osmesa or =egl chooses one.
Runs that need no pictures go without it: --set simulator.render=false"""
PACKAGES: Final[Mapping[str, tuple[str, ...]]] = {
    OTHER_SYSTEM: ("libegl1", "libopengl0", "libgl1-mesa-dri"),
}
"""Packages of Mesa's EGL and of its software OpenGL."""


def diagnose() -> Diagnosis:
    """Render a picture in another process and say how that went; takes about a second."""
    _, diagnosis = _examine()
    return diagnosis


def open_context(driver: str) -> Any:
    """A context of OpenGL, by "egl" or "osmesa"; what fails raises errors of many kinds."""
    # The process that started this one may have set another driver, which is inherited.
    os.environ[PYOPENGL_VARIABLE] = driver
    # mujoco's own name for its driver; each of these modules loads one when it is imported.
    return importlib.import_module(f"mujoco.{driver}").GLContext(1, 1)


@functools.cache
def find_driver() -> str:
    """The driver that renders, "egl" or "osmesa"; in each process it is searched for only once.

    Raises:
        UserError: MuJoCo cannot render; the message says what to install. The next call searches
            again.
    """
    driver, diagnosis = _examine()
    if not diagnosis.works:
        raise UserError(diagnosis.text())
    return driver


def _examine() -> tuple[str, Diagnosis]:
    """Try one driver after another; return the first that renders, and what was found."""
    chosen = os.environ.get(VARIABLE, "").strip().lower()
    problems = []
    for driver in DRIVERS if chosen not in DRIVERS else (chosen,):
        device, problem = _try(driver)
        if not problem:
            return driver, Diagnosis(True, f"MuJoCo renders on {device} by {driver}")
        problems.append(f"{driver}: {problem}")
    found = f"MuJoCo cannot render: {'; '.join(problems)}"
    if chosen in DRIVERS:
        found += f" ({VARIABLE} is {chosen})"
    return "", Diagnosis(False, found, CURE, PACKAGES)


def _try(driver: str) -> tuple[str, str]:
    """Render with a driver; return the device that rendered, and the problem, empty if none."""
    try:
        answer = answer_of(Path(__file__).with_name("probe.py"), driver)
    except ProbeError as error:
        return "", str(error)
    return answer["device"], answer["problem"]
