"""Joins a run from any machine: plays as many of its actors as this machine has cores."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from deploy.exit_status import exit_status
from deploy.processes import VMDNN, Program
from deploy.run_local import RunConsole
from deploy.supervision import Supervisor, Watchdog
from proto.config import Config, load_config
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.machine import usable_cores
from proto.permissions import Holder
from proto.run_locks import owned_run
from proto.security import certificate_for
from services.arguments.common import integer
from services.arguments.process import PRIVATE

LOOK_EVERY_S: Final = 1.0


def main(argv: Sequence[str] | None = None) -> int:
    """Play actors of a run until this process is to stop.

    Args:
        argv: the arguments; None for those of the process.

    Returns:
        The exit status.
    """
    arguments = _parser().parse_args(argv)
    return exit_status(
        "join", lambda: _main(arguments), again="the same command joins the run again"
    )


def _main(arguments: argparse.Namespace) -> None:
    overrides = _overrides(arguments)
    config = load_config(None, overrides)
    certificate_for(config.hub, Holder.ACTOR)
    number = usable_cores() if arguments.actors is None else arguments.actors
    join(config, _command(arguments, overrides), number)


def join(config: Config, command: Sequence[str], number: int) -> None:
    """Play actors until this process is to stop.

    Args:
        config: name and folder of the run, and its hub.
        command: the command of an actor.
        number: number of actors.

    Raises:
        UserError: the folder cannot be used, or the run is being played there already.
        ProcessFailedError: an actor can never work.
        SupervisorEndedError: supervisord was killed.
    """
    lifecycle, console = Lifecycle(), RunConsole()
    lifecycle.stop_on_signals()

    def tell(text: str) -> None:
        console.print(text, highlight=False, markup=False, soft_wrap=True)

    logs = config.run_folder / "logs"
    with owned_run(config.run_folder):
        programs = [Program("actor", command, processes=number)]
        with Supervisor(programs, logs) as supervisor:
            watchdog = Watchdog(supervisor, tell)
            supervisor.start("actor")
            tell(
                f"{number} {'actor' if number == 1 else 'actors'} for the run {config.run.name} at"
                f" {config.hub.endpoint}; logs in {logs}"
            )
            while not lifecycle.stopping:
                watchdog.look_unless_stopping(lifecycle)
                lifecycle.wait(LOOK_EVERY_S)
            tell("stopping; the same command joins the run again")


def _overrides(arguments: argparse.Namespace) -> list[str]:
    overrides = [*arguments.overrides, f"hub.endpoint={arguments.hub}"]
    if arguments.hub.startswith("tls/"):
        overrides.append("hub.security=mutual-tls")
    if arguments.certificates is not None:
        overrides.append(f"hub.certificates={arguments.certificates.absolute()}")
    if arguments.run is not None:
        overrides.append(f"run.name={arguments.run}")
    return overrides


def _command(arguments: argparse.Namespace, overrides: Sequence[str]) -> list[str]:
    """The command of an actor, which takes the run's configuration from the bus."""
    run = load_config(None, overrides).run.name
    command = [VMDNN, Role.ACTOR.value, "--run", run]
    for override in overrides:
        command += ["--set", override]
    if arguments.backend is not None:
        command += ["--backend", arguments.backend]
    return command


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="join", add_help=False)  # join.sh prints the help
    parser.add_argument("--hub", required=True)
    parser.add_argument("--certificates", type=Path)
    parser.add_argument("--actors", type=integer(1))
    parser.add_argument("--run")
    parser.add_argument("--backend")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    return parser


if __name__ == "__main__":
    os.umask(PRIVATE)
    sys.exit(main())
