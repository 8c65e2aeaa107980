"""How many cores a process may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from proto.machine import usable_cores


@pytest.fixture(autouse=True)
def eight_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))


def write(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


GROUP = {"proc/self/cgroup": "0::/outer/inner\n"}
V1 = {"proc/self/cgroup": "4:cpu,cpuacct:/job\n1:memory:/job\n0::/\n"}


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, 8),
        (GROUP, 8),
        (GROUP | {"sys/fs/cgroup/outer/inner/cpu.max": "max 100000\n"}, 8),
        (GROUP | {"sys/fs/cgroup/outer/inner/cpu.max": "250000 100000\n"}, 2),
        (GROUP | {"sys/fs/cgroup/outer/cpu.max": "300000 100000\n"}, 3),
        (GROUP | {"sys/fs/cgroup/cpu.max": "50000 100000\n"}, 1),
        (GROUP | {"sys/fs/cgroup/cpu.max": "nonsense\n"}, 8),
        (
            V1
            | {
                "sys/fs/cgroup/cpu,cpuacct/job/cpu.cfs_quota_us": "400000\n",
                "sys/fs/cgroup/cpu,cpuacct/job/cpu.cfs_period_us": "100000\n",
            },
            4,
        ),
        (
            V1
            | {
                "sys/fs/cgroup/cpu,cpuacct/job/cpu.cfs_quota_us": "-1\n",
                "sys/fs/cgroup/cpu,cpuacct/job/cpu.cfs_period_us": "100000\n",
            },
            8,
        ),
    ],
)
def test_a_quota_limits_the_cores(files: dict[str, str], cores: int, tmp_path: Path) -> None:
    assert usable_cores(write(tmp_path, files)) == cores
