"""Runs actors of a run whose other processes are elsewhere, supervised as `run_local` does it."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from deploy.exit_status import exit_status
from deploy.processes import programs
from deploy.supervision import Supervisor, Watchdog
from proto.lifecycle import Lifecycle
from services.arguments.common import add_process, config_of

LOOK_EVERY_S: Final = 1.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run an actor until this process is asked to stop.

    Args:
        argv: the arguments; None for those of the process.

    Returns:
        The exit status.
    """
    parser = argparse.ArgumentParser(prog="actors", description=__doc__)
    add_process(parser)
    parser.add_argument("--backend", help="the simulator; without it, simulator.backend")
    arguments = parser.parse_args(argv)
    return exit_status("actors", lambda: _main(arguments), again="the same command starts it again")


def _main(arguments: argparse.Namespace) -> None:
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    config = config_of(arguments)
    name = arguments.id or "actor"
    logs = config.run_folder / "logs" / name
    file = logs / "config.yaml"
    config.save(file)
    *_, actor = programs(config, file, {arguments.backend or config.simulator.backend: 1})
    words = () if arguments.id is None else ("--id", arguments.id)
    actor = replace(actor, command=[*actor.command, *words])
    with Supervisor([actor], logs) as supervisor:
        watchdog = Watchdog(supervisor, _tell)
        supervisor.start(actor.name)
        _tell(f"{name} runs; its log is {logs / actor.name}.log")
        while not lifecycle.stopping:
            watchdog.look_unless_stopping(lifecycle)
            lifecycle.wait(LOOK_EVERY_S)


def _tell(text: str) -> None:
    print(time.strftime("%F %T"), text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
