"""`vmdnn replay`: make a video of a recorded episode, or show it in the browser."""

from __future__ import annotations

import argparse
from pathlib import Path

from proto.config import SimulatorConfig
from proto.recordings.episodes import read_episode
from services.arguments.common import add_config, config_of
from services.dashboard.one_recording import show_recording
from services.playing.video import write_video
from services.playing.video_file import video_argument
from services.terminal.progress import progress_bar


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    parser.add_argument("file", type=Path, help="recorded episode, whole or recovered")
    shown = parser.add_mutually_exclusive_group(required=True)
    shown.add_argument("--out", type=video_argument, help="file to write, .mp4 or .gif")
    shown.add_argument(
        "--open",
        action="store_true",
        help="show it in the browser, with joints and phases beside the video",
    )
    parser.add_argument("--fps", type=float, help="steps per second; without it, real time")
    parser.add_argument(
        "--backend", help="simulator that renders; without it, the one that played the episode"
    )
    add_config(parser)


def run(arguments: argparse.Namespace) -> int:
    """Render the episode as a video, or show it until Ctrl-C."""
    if arguments.open:
        show_recording(arguments.file, config_of(arguments))
        return 0
    episode = read_episode(arguments.file, partial=True)
    simulator = SimulatorConfig(backend=arguments.backend or episode.backend)
    config = config_of(arguments).model_copy(update={"simulator": simulator})
    with progress_bar("rendering", episode.steps) as advance:
        write_video([episode], arguments.out, config, fps=arguments.fps, on_frame=advance)
    print(f"{arguments.out}: {episode.steps} frames")
    return 0
