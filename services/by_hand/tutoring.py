"""Serves the page on which a person tutors, until Ctrl-C or SIGTERM."""

from __future__ import annotations

import os
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from proto.config import Config
from proto.lifecycle import Lifecycle
from services.by_hand.robot import Robot
from services.by_hand.server import make_app
from services.dashboard.access import Access
from services.dashboard.ports import address_of, listening_socket
from services.dashboard.server import serving
from services.playing.tutoring import Case

HOST: Final = "127.0.0.1"
"""Whoever opens the page moves the robot, so only this machine can open it."""
_LOOK_AGAIN_S: Final = 0.5


def tutor_by_hand(config: Config, cases: Sequence[Case], folder: Path, port: int | None) -> int:
    """Let a person tutor; return how many demonstrations the folder has.

    Args:
        config: the configuration.
        cases: the situations to tutor, in their order.
        folder: where demonstrations are recorded.
        port: port of the page, 0 for any free one; None for `dashboard.port` or the next free one.

    Raises:
        UserError: the port is taken, the folder was recorded with other settings, or the simulator
            cannot run here.
    """
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    robot = Robot(config, cases, folder)
    wanted = config.dashboard.port if port is None else port
    listening = listening_socket(HOST, wanted, or_another=port is None)
    with robot.working(), serving(make_app(robot, Access(HOST)), listening):
        address = address_of(listening)
        print(f"tutor by hand at {address} (Ctrl-C ends)", flush=True)
        if any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))):
            webbrowser.open(address)  # elsewhere it could start a browser in this terminal
        while not lifecycle.stopping and robot.failed is None:
            lifecycle.wait(_LOOK_AGAIN_S)
    if robot.failed is not None:
        raise robot.failed
    return robot.kept
