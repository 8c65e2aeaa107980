"""`python -m actors.backends`: say whether a run can render here, and what to install if not.

It takes the arguments of deploy/run_local.sh, and looks at the backend that they choose. What was
found goes to standard error. If the backend cannot render, the arguments of `apt-get install` that
provide the graphics driver go to standard output, if any are known. If its Python package is not
installed, the name of the extra that has it goes there.

Exit status: 0 if the backend can render or the run needs no pictures, 1 if not, 2 for bad input, 3
if its Python package is not installed.
"""

from __future__ import annotations

import argparse
import platform
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from actors.simulator import BACKENDS, is_installed, load_backend
from proto.config import Config, load_config
from proto.errors import UserError

NOT_INSTALLED: Final = 3
"""Exit status if the Python package of the backend is not installed."""


def main(argv: Sequence[str] | None = None) -> int:
    """Print the diagnosis; the result is the exit status."""
    try:
        config = _config_of(argv)
        backend = config.simulator.backend
        if backend in BACKENDS and not is_installed(backend):
            print(f"the packages of {backend} are not installed", file=sys.stderr)
            print(backend)
            return NOT_INSTALLED
        if not config.simulator.render:
            print("no pictures are needed: simulator.render is false", file=sys.stderr)
            return 0
        diagnosis = load_backend(backend).diagnose()
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
