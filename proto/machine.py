"""This machine: the name of its processor, and how many cores a process may use."""

from __future__ import annotations

import os
import platform
import re
from pathlib import Path


def machine_name() -> str:
    """Processor, and the number of cores that this process may use."""
    cores = usable_cores()
    return f"{_processor()}, {cores} core{'s' if cores > 1 else ''}"


def usable_cores(root: Path = Path("/")) -> int:
    """Return how many cores this process may use: as many as are allowed, no more than its quota.

    Containers, Slurm and systemd limit cores by affinity (cpusets), or processor time by quotas.

    Args:
        root: where /proc and /sys are.
    """
    allowed = len(os.sched_getaffinity(0))
    quotas = [quota for folder in _cgroups(root) if (quota := _quota(folder)) is not None]
    return max(1, min([allowed, *(int(quota) for quota in quotas)]))


def _cgroups(root: Path) -> list[Path]:
    """Folders of this process's control groups, and of those that contain them."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return []
    folders = []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        mounts = ["sys/fs/cgroup", "sys/fs/cgroup/unified"]
        if controllers:
            mounts = [f"sys/fs/cgroup/{controllers}"]
            if "cpu" not in controllers.split(","):
                continue
        for mount in mounts:
            group = root / mount / path.lstrip("/")
            folders += [group, *(p for p in group.parents if p.is_relative_to(root / mount))]
    return folders


def _quota(folder: Path) -> float | None:
    """Processor time of a control group, in cores; None if it is not limited."""
    try:
        if (limit := folder / "cpu.max").exists():  # version 2
            quota, period = limit.read_text().split()
        else:
            quota = (folder / "cpu.cfs_quota_us").read_text()
            period = (folder / "cpu.cfs_period_us").read_text()
        return None if quota == "max" or int(quota) <= 0 else int(quota) / int(period)
    except (OSError, ValueError, ZeroDivisionError):
        return None


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        text = ""
    found = re.search(r"^model name\s*: (.*)$", text, re.MULTILINE)
    return found[1] if found else platform.processor() or platform.machine()
