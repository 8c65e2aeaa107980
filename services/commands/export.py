"""`vmdnn export`: write recordings in a format of others."""

from __future__ import annotations

import argparse
from pathlib import Path

from proto.config import SimulatorConfig
from proto.episode import Episode
from services.arguments.common import add_config, config_of
from services.exchange.eipl import export_eipl
from services.exchange.lerobot import export_lerobot
from services.exchange.npz import export_npz
from services.exchange.selection import common_period_s, read_each, recordings_in
from services.playing.video import write_video


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    parser.add_argument(
        "paths",
        type=Path,
        nargs="+",
        help="recordings, or folders of recordings; of a run's folder those in tutoring/ and"
        " rollouts/",
    )
    parser.add_argument(
        "--format", required=True, choices=("lerobot", "eipl", "npz", "video"), help="what to write"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    parser.add_argument(
        "--h264",
        action="store_true",
        help="lerobot: pictures as H.264 videos, which lose a little, instead of PNG",
    )
    parser.add_argument(
        "--test-share",
        type=_share,
        default=0.2,
        help="eipl: share of the situations that go to the test set",
    )
    add_config(parser)


def run(arguments: argparse.Namespace) -> int:
    """Export the recordings."""
    files = recordings_in(arguments.paths)
    out: Path = arguments.out
    if arguments.format == "lerobot":
        period_s = common_period_s(read_each(files))
        count = export_lerobot(read_each(files), out, period_s=period_s, videos=arguments.h264)
        print(f"{out}: {count} episodes as a LeRobotDataset")
    elif arguments.format == "eipl":
        sets = export_eipl(list(read_each(files)), out, arguments.test_share)
        print(f"{out}: {', '.join(f'{count} in {name}' for name, count in sets.items())}")
    else:
        for episode in read_each(files):
            print(_export_one(episode, arguments))
    return 0


def _export_one(episode: Episode, arguments: argparse.Namespace) -> Path:
    out: Path = arguments.out
    if arguments.format == "npz":
        return export_npz(episode, out)
    path = out / f"{episode.id}.mp4"
    simulator = SimulatorConfig(backend=episode.backend)
    write_video([episode], path, config_of(arguments).model_copy(update={"simulator": simulator}))
    return path


def _share(text: str) -> float:
    try:
        share = float(text)
    except ValueError:
        share = -1.0
    if not 0.0 < share < 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number between 0 and 1")
    return share
