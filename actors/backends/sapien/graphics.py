"""Whether SAPIEN can render on this machine, and what cures it if not.

`python -m actors.backends.sapien.graphics` prints the answer; exit status 1 means no.
"""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from proto.errors import UserError

TIMEOUT_S: Final = 120.0
CURE: Final = """\
SAPIEN renders with Vulkan, also without a GPU. What provides it (as root):
  Debian 12, no NVIDIA card: Mesa 24.3 or newer, which is in bookworm-backports:
    apt-get install -t bookworm-backports mesa-vulkan-drivers libvulkan1
  Ubuntu 24.04, no NVIDIA card: Mesa 24.3 or newer, which is in noble-updates:
    apt-get update && apt-get install mesa-vulkan-drivers libvulkan1
  NVIDIA card: the driver's own Vulkan, of the same version as the kernel module (`nvidia-smi`):
    apt-get install libnvidia-gl-VERSION libvulkan1 (Debian: nvidia-vulkan-icd)
Runs that need no pictures go without it: --set simulator.render=false"""


@dataclass(frozen=True)
class GraphicsReport:
    """What `diagnose` found.

    Attributes:
        device: name of the device that SAPIEN renders on, empty if it cannot.
        known: name and driver of every device that Vulkan finds.
        problem: what is wrong, in one line; empty if nothing.
    """

    device: str
    known: tuple[tuple[str, str], ...]
    problem: str

    @property
    def works(self) -> bool:
        """Whether SAPIEN can render."""
        return not self.problem

    def text(self) -> str:
        """What to tell the user, in one line if all is well, else with what to do."""
        if self.works:
            return f"SAPIEN renders on {self.device}"
        return f"SAPIEN cannot render: {self.problem}.\n{CURE}"


def diagnose() -> GraphicsReport:
    """Draw a picture in another process and say how that went; takes about a second."""
    probe = Path(__file__).with_name("probe.py")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(sys.path),
        "PYTHONWARNINGS": "ignore",
    }
    try:
        result = subprocess.run(
            [sys.executable, "-P", str(probe)],
            env=environment,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return GraphicsReport("", (), f"the graphics driver hung for {TIMEOUT_S:.0f} s")
    if result.returncode != 0:
        return GraphicsReport("", (), _crash(result))
    answer = json.loads(result.stdout.splitlines()[-1])
    known = tuple((name, driver) for name, driver in answer["known"])
    return GraphicsReport(answer["device"], known, _problem(answer["problem"], known))


@functools.cache
def require_graphics() -> None:
    """Return at once if rendering was seen to work in this process before, else try it.

    Raises:
        UserError: SAPIEN cannot render; the message says what to install. Asked again, it tries
            again.
    """
    report = diagnose()
    if not report.works:
        raise UserError(report.text())


def _crash(result: subprocess.CompletedProcess[str]) -> str:
    if result.returncode < 0:
        return f"the graphics driver crashed (signal {-result.returncode})"
    last = (result.stderr.strip().splitlines() or ["no message"])[-1]
    return f"the attempt ended with status {result.returncode}: {last}"


def _problem(problem: str, known: tuple[tuple[str, str], ...]) -> str:
    if not problem:
        return ""
    if not known:
        return f"no Vulkan driver was found ({problem})"
    listing = ", ".join(f"{name} by {driver}" for name, driver in known)
    return f"the Vulkan driver is too old or incomplete ({listing}: {problem})"


def main() -> int:
    """Print the answer."""
    report = diagnose()
    print(report.text())
    return 0 if report.works else 1


if __name__ == "__main__":
    sys.exit(main())
