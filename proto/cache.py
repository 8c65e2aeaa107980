"""Where this machine keeps what was built once and can be built again: the robot, the kernels.

Only the standard library may be imported here: setup.py uses this before anything is installed.
"""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """`$VMDNN_CACHE`, or `~/.cache/vmdnn`; it need not exist yet."""
    return Path(os.environ.get("VMDNN_CACHE") or Path.home() / ".cache" / "vmdnn")
