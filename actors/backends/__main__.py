"""`python -m actors.backends`: say whether a run can render here, and what to install if not.

It takes the arguments of deploy/run_local.sh, and looks at the backends that they choose. What was
found goes to standard error. If a backend cannot render, the arguments of `apt-get install` that
provide its graphics driver go to standard output, if any are known. If Python packages are not
installed, the names of the extras that have them go there.

Exit status: 0 if all backends can render or the run needs no pictures, 1 if not, 2 for bad input, 3
if Python packages are not installed.
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
        config, backends = _chosen_by(argv)
        missing = [each for each in backends if each in BACKENDS and not is_installed(each)]
        if missing:
            print(f"the packages of {', '.join(missing)} are not installed", file=sys.stderr)
            print(*missing)
            return NOT_INSTALLED
        if not config.simulator.render:
            print("no pictures are needed: simulator.render is false", file=sys.stderr)
            return 0
        diagnoses = [load_backend(backend).diagnose() for backend in backends]
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    packages: dict[str, None] = {}
    for diagnosis in diagnoses:
        print(diagnosis.text(), file=sys.stderr)
        packages |= dict.fromkeys(diagnosis.packages_for(_system()))
    if all(diagnosis.works for diagnosis in diagnoses):
        return 0
    if packages:
        print(*packages)
    return 1


def _chosen_by(argv: Sequence[str] | None) -> tuple[Config, list[str]]:
    """What deploy/run_local.py reads from the same arguments: configuration and backends."""
    parser = argparse.ArgumentParser(prog="python -m actors.backends", add_help=False)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--backend")
    parser.add_argument("--actors", default="")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    arguments, _ = parser.parse_known_args(argv)
    overrides = list(arguments.overrides)
    if arguments.backend is not None:
        overrides.append(f"simulator.backend={arguments.backend}")
    config = load_config(arguments.config, overrides)
    named = [part.strip().rpartition("=") for part in arguments.actors.split(",") if "=" in part]
    return config, [name for name, _, count in named if count != "0"] or [config.simulator.backend]


def _system() -> str:
    """Name and version of this system, such as debian-12."""
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        return ""
    return f"{release['ID']}-{release.get('VERSION_ID', '')}"


if __name__ == "__main__":
    sys.exit(main())
