"""Reading files whose size is not trusted."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from proto.errors import UserError

_PIECE: Final = 2**20


class TooLargeError(UserError):
    """A file is larger than any file of its kind."""


def read_limited(path: Path, most: int) -> bytes:
    """Read a whole file; nothing is read if it is too large.

    Args:
        path: the file.
        most: largest size (bytes).

    Raises:
        TooLargeError: it is larger.
        OSError: it cannot be read.
    """
    with path.open("rb") as stream:
        size = path.stat().st_size
        content = b"" if size > most else stream.read(size + 1)
        # Some files, such as devices, do not tell their size; others grow meanwhile.
        while size < len(content) <= most and (more := stream.read(_PIECE)):
            content += more
    if size > most or len(content) > most:
        raise TooLargeError(f"{path} is larger than {most} bytes, which no such file is")
    return content
