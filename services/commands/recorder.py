"""`vmdnn recorder`."""

from __future__ import annotations

import argparse

from proto.keys import Role
from proto.membership import Lifecycle, only_one
from services.arguments.common import add_process, config_of, start_logging
from services.recorder import Recorder


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_process(parser)


def run(arguments: argparse.Namespace) -> int:
    """Record rollouts until told to stop."""
    start_logging("recorder")
    config = config_of(arguments)
    process = arguments.id or "recorder"
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    with only_one(config.run_folder, Role.RECORDER, process):
        Recorder(config, process).run(lifecycle)
    return 0
