"""Trained policies that come with the package, `pretrained:NAME` wherever a policy is named.

`docs/results.md` says how each was trained, and how well it does.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from proto.errors import UserError

PREFIX: Final = "pretrained:"
_FOLDER: Final = Path(__file__).parent


def pretrained_names() -> list[str]:
    """Names of the policies that there are, with the prefix."""
    return sorted(f"{PREFIX}{path.stem}" for path in _FOLDER.glob("*.safetensors"))


def checkpoint_path(name: str | Path) -> Path:
    """File of a checkpoint: a path as it is, the newest policy of a run, or `pretrained:NAME`.

    Args:
        name: a path, the folder of a run, or `pretrained:NAME`.

    Raises:
        UserError: no policy of this name comes with the package, or there is none in the folder.
    """
    text = str(name)
    if not text.startswith(PREFIX):
        path = Path(name)
        return _newest_policy(path) if path.is_dir() else path
    path = _FOLDER / f"{text.removeprefix(PREFIX)}.safetensors"
    if not path.is_file():
        raise UserError(
            f"there is no policy {text}; with the package come: {', '.join(pretrained_names())}"
        )
    return path


def _newest_policy(run_folder: Path) -> Path:
    policies = sorted(run_folder.glob("policies/[0-9]*.safetensors"))
    if not policies:
        raise UserError(f"the folder {run_folder} holds no policy (policies/*.safetensors)")
    return policies[-1]
