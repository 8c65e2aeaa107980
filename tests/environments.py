"""Environments of their own for programs of others that read what vmdnn writes."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Sequence
from pathlib import Path

import pytest


def environment(
    cache: pytest.Cache,
    name: str,
    requirements: Sequence[str],
    *,
    alone: Sequence[str] = (),
    see: Sequence[Path] = (),
) -> Path:
    """Return the Python of an environment that has these packages; pytest's cache keeps it.

    The test is skipped where the packages cannot be installed.

    Args:
        cache: pytest's cache.
        name: name of the environment.
        requirements: packages with their versions, such as `rerun-sdk==0.41.0`.
        alone: the same, installed without what they depend on.
        see: folders with further packages, used where the environment has no other version.
    """
    content = repr((sys.version, requirements, alone, see))
    digest = hashlib.sha256(content.encode()).hexdigest()[:12]
    folder = cache.mkdir("environments") / f"{name}-{digest}"
    python = folder / "bin" / "python"
    complete = folder / "complete"
    if complete.exists():
        return python
    shutil.rmtree(folder, ignore_errors=True)
    venv.create(folder, with_pip=False)
    _install(python, requirements)
    if alone:
        _install(python, ("--no-deps", *alone))
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(folder)}))
    (packages / "further.pth").write_text("\n".join(map(str, see)))
    complete.touch()
    return python


def _install(python: Path, words: Sequence[str]) -> None:
    pip = (sys.executable, "-m", "pip", "--python", python, "--disable-pip-version-check")
    command = (*pip, "install", "--quiet", "--retries", "1", *words)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        problem = done.stderr.strip().splitlines()[-1:]
        pytest.skip(f"{' '.join(words)} cannot be installed here: {' '.join(problem)}")
