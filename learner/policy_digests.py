"""Digests of a run's policies, by which a changed bit in any of them is found.

`policies/SHA256SUMS` has a line for each policy, as the command `sha256sum --check` reads it. The
policies of older runs have none.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Final

from proto.errors import UserError
from proto.reading import read_limited
from proto.storage import written_whole

DIGESTS: Final = "SHA256SUMS"
_LARGEST_FILE: Final = 2**24
_LINE: Final = re.compile(r"([0-9a-f]{64})  ([0-9]{6}\.safetensors)")


def note_digest(policy: Path, content: bytes) -> None:
    """Write down the digest of a policy, unless it is there.

    Args:
        policy: its file.
        content: what is in it.

    Raises:
        StorageError: it cannot be written; nothing has changed.
    """
    digests, digest = _digests(policy.parent), hashlib.sha256(content).hexdigest()
    if digests.get(policy.name) == digest:
        return
    lines = (digests | {policy.name: digest}).items()
    with written_whole(policy.parent / DIGESTS) as stream:
        stream.write("".join(f"{each}  {name}\n" for name, each in sorted(lines)).encode())


def digest_problem(policy: Path, content: bytes) -> str:
    """Return why a policy is not what was published; empty if it is, or has no digest.

    Args:
        policy: its file.
        content: what is in it.
    """
    digest = _digests(policy.parent).get(policy.name)
    if digest in (None, hashlib.sha256(content).hexdigest()):
        return ""
    return f"its content differs from its digest in {DIGESTS}"


def _digests(folder: Path) -> dict[str, str]:
    """The digests by name of the file; lines that are none are left out."""
    try:
        text = read_limited(folder / DIGESTS, _LARGEST_FILE).decode(errors="replace")
    except (OSError, UserError):
        return {}
    return {name: digest for digest, name in _LINE.findall(text)}
