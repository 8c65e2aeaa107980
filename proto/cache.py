"""Where this machine keeps what was built once and can be built again: the robot, the kernels.

Only the standard library may be imported here: setup.py uses this before anything is installed.
"""

from __future__ import annotations

import grp
import os
import pwd
import stat
import tempfile
from pathlib import Path


def cache_folder() -> Path:
    """`$VMDNN_CACHE`, or `~/.cache/vmdnn`; it need not exist yet.

    A user without a home, as in a container with an arbitrary user id, has a folder among the
    temporary files.
    """
    if named := os.environ.get("VMDNN_CACHE"):
        return Path(named)
    try:
        return Path.home() / ".cache" / "vmdnn"
    except RuntimeError:  # HOME is not set, and the user has no name
        return private_folder()


def private_folder() -> Path:
    """A folder of this user for the case that others can write into `cache_folder`."""
    return Path(tempfile.gettempdir()) / f"vmdnn-{os.getuid()}"


def writable_by_others(path: Path) -> str:
    """Why others than this user and root could replace a file or what is in a folder.

    Args:
        path: the file or folder; what does not exist yet is judged by the folders above it.

    Returns:
        The reason, or an empty text.
    """
    path = Path(os.path.abspath(path))  # noqa: PTH100 - keeps symbolic links, which count too
    for place in (path, *path.parents):
        if not place.exists():
            continue
        if reason := _reason(place) or (place.is_symlink() and writable_by_others(place.resolve())):
            return reason
    return ""


def _reason(place: Path) -> str:
    status = place.lstat()
    if status.st_uid not in (os.getuid(), 0):
        return f"{place} belongs to another user ({status.st_uid})"
    if stat.S_ISLNK(status.st_mode):  # its own mode means nothing
        return ""
    if stat.S_ISDIR(status.st_mode) and status.st_mode & stat.S_ISVTX:
        return ""  # such as /tmp: only the owner can replace a file
    if status.st_mode & stat.S_IWOTH:
        return f"everyone can write to {place}"
    if status.st_mode & stat.S_IWGRP and not _is_own_group(status.st_gid):
        return f"the group {status.st_gid} can write to {place}"
    return ""


def _is_own_group(number: int) -> bool:
    """Whether nobody else is in a group: root's, or the one that is made for each user."""
    if number == 0:
        return True
    try:
        group, user = grp.getgrgid(number), pwd.getpwuid(os.getuid())
    except KeyError:
        return False
    own = group.gr_name == user.pw_name and user.pw_gid == number
    return own and set(group.gr_mem) <= {user.pw_name}
