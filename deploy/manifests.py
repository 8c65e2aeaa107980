"""Writes the files with which systemd, Slurm, Kubernetes or Compose run the processes of a run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from deploy.engines.compose import compose_files
from deploy.engines.kubernetes import kubernetes_files
from deploy.engines.plan import Plan
from deploy.engines.slurm import slurm_files
from deploy.engines.systemd import systemd_files
from deploy.exit_status import exit_status
from deploy.run_local import check_actors, parse_actors
from proto.config import load_config
from proto.storage import written_whole
from services.arguments.common import config_argument

ENGINES: Final[Mapping[str, Callable[[Plan], dict[str, str]]]] = {
    "systemd": systemd_files,
    "slurm": slurm_files,
    "kubernetes": kubernetes_files,
    "compose": compose_files,
}
ACTORS: Final = 4


def main(argv: Sequence[str] | None = None) -> int:
    """Write the files of an engine.

    Args:
        argv: the arguments; None for those of the process.

    Returns:
        The exit status.
    """
    arguments = _parser().parse_args(argv)
    return exit_status("manifests", lambda: _main(arguments))


def _main(arguments: argparse.Namespace) -> None:
    for path, text in manifests(arguments).items():
        with written_whole(arguments.out / path) as stream:
            stream.write(text.encode())
        if path.endswith(".sh"):
            (arguments.out / path).chmod(0o755)
        print(arguments.out / path)


def manifests(arguments: argparse.Namespace) -> dict[str, str]:
    """Return the files of an engine by their paths in the folder `out`.

    Raises:
        UserError: the configuration is not valid, or no actor can play a suite.
    """
    config = load_config(arguments.config)
    given = arguments.actors
    actors = given if isinstance(given, Mapping) else {config.simulator.backend: given}
    check_actors(actors, config)
    plan = Plan(
        config=config,
        config_text=arguments.config.read_text(),
        actors=actors,
        out=arguments.out,
        python=arguments.python,
    )
    return ENGINES[arguments.engine](plan)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m deploy.manifests", description=__doc__)
    parser.add_argument("engine", choices=list(ENGINES))
    parser.add_argument(
        "--config", type=config_argument, required=True, metavar="FILE|NAME", help="of the run"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    parser.add_argument(
        "--actors",
        type=parse_actors,
        default=ACTORS,
        help="number of actors, or numbers by simulator such as sapien=2,mujoco=1",
    )
    parser.add_argument(
        "--python",
        default=".venv/bin/python",
        help="Python that runs vmdnn, for systemd and Slurm; vmdnn is in its folder",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
