"""Shows one recording in the browser, without a run."""

from __future__ import annotations

import os
import webbrowser
from pathlib import Path

from actors.tasks.registry import make_task
from proto.config import Config
from proto.lifecycle import Lifecycle
from proto.recordings.episodes import read_heading
from services.archive import OneRecording
from services.dashboard.access import Access
from services.dashboard.ports import address_of, listening_socket
from services.dashboard.run_source import Source
from services.dashboard.server import make_app, serving
from services.dashboard.videos import Videos


def show_recording(file: Path, config: Config) -> None:
    """Show a recording until Ctrl-C or SIGTERM.

    Args:
        file: the recording.
        config: options of its task, and where the page can be opened.

    Raises:
        UserError: it cannot be read, its task is not known, or nothing can listen there.
    """
    task = make_task(config.task_called(read_heading(file).task))
    source = Source(OneRecording(file), task)
    host = config.dashboard.host
    lifecycle = Lifecycle()
    lifecycle.stop_on_signals()
    listening = listening_socket(host, config.dashboard.port, or_another=True)
    with Videos(config) as videos, serving(make_app(source, Access(host), videos), listening):
        address = address_of(listening)
        print(f"{file}: {address} (Ctrl-C ends)", flush=True)
        if any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))):
            webbrowser.open(address)  # elsewhere it could start a browser in this terminal
        while not lifecycle.stopping:
            lifecycle.wait(1.0)
