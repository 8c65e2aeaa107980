"""`python -m actors.backends`: say whether a run can render here, and what to install if not.

It takes the arguments of deploy/run_local.sh, and looks at the backend that they choose. What was
found goes to standard error. If the backend cannot render, the arguments of `apt-get install` that
provide the graphics driver go to standard output, if any are known.

Exit status: 0 if the backend can render or the run needs no pictures, 1 if not, 2 for bad input.
"""

from __future__ import annotations

import argparse
import platform
import sys
from collections.abc import Sequence
from pathlib import Path

from actors.simulator import load_backend
from proto.config import Config, load_config
from proto.errors import UserError


def main(argv: Sequence[str] | None = None) -> int:
    """Print the diagnosis; the result is the exit status."""
    try:
        config = _config_of(argv)
        if not config.simulator.render:
            print("no pictures are needed: simulator.render is false", file=sys.stderr)
            return 0
        diagnosis = load_backend(config.simulator.backend).diagnose()
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    print(diagnosis.text(), file=sys.stderr)
    if diagnosis.works:
        return 0
    if packages := diagnosis.packages_for(_system()):
        print(*packages)
    return 1


def _config_of(argv: Sequence[str] | None) -> Config:
    """The configuration that deploy/run_local.py reads from the same arguments."""
    parser = argparse.ArgumentParser(prog="python -m actors.backends", add_help=False)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--backend")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    arguments, _ = parser.parse_known_args(argv)
    overrides = list(arguments.overrides)
    if arguments.backend is not None:
        overrides.append(f"simulator.backend={arguments.backend}")
    return load_config(arguments.config, overrides)


def _system() -> str:
    """Name and version of this system, such as debian-12."""
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        return ""
    return f"{release['ID']}-{release.get('VERSION_ID', '')}"


if __name__ == "__main__":
    sys.exit(main())
