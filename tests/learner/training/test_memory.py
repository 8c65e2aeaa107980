"""Tests of the allocator's settings."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

PAGES_OF_ALL_ARRAYS = 60 * 64 * 2**20 // 4096

PROGRAM = """
import resource
import torch
from learner.training.memory import keep_freed_memory

def pages():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

keep_freed_memory()
before = pages()
for _ in range(60):
    torch.ones(2**24)
print(pages() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="setting of the GNU C library")
def test_arrays_that_were_freed_are_used_again() -> None:
    printed = subprocess.run(
        [sys.executable, "-c", PROGRAM], check=True, capture_output=True, text=True
    ).stdout
    assert int(printed) < PAGES_OF_ALL_ARRAYS / 4
