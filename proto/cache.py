"""Where this machine keeps what was built once and can be built again: the robot, the kernels.

Only the standard library may be imported here: setup.py uses this before anything is installed.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path


def cache_folder() -> Path:
    """`$VMDNN_CACHE`, or `~/.cache/vmdnn`; it need not exist yet.

    A user without a home, as in a container with an arbitrary user id, has a folder among the
    temporary files.

    Raises:
        PermissionError: there is such a folder, but it is another user's.
    """
    if named := os.environ.get("VMDNN_CACHE"):
        return Path(named)
    try:
        return Path.home() / ".cache" / "vmdnn"
    except RuntimeError:  # HOME is not set, and the user has no name
        return _temporary_folder()


def _temporary_folder() -> Path:
    folder = Path(tempfile.gettempdir()) / f"vmdnn-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise PermissionError(f"{folder} is another user's; set VMDNN_CACHE to a folder of yours")
    return folder
