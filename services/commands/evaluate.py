"""`vmdnn evaluate`: test a policy on situations that were never tutored."""

from __future__ import annotations

import argparse
import json
import time
from contextlib import closing
from pathlib import Path

from rich.console import Console

from services.commands.options import add_config, add_playing, playing_config, positive
from services.evaluation import result_json, trial_jobs
from services.playing import play_all
from services.progress import progress_bar
from services.replay import write_video
from services.success import Tally
from services.tables import success_table


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    add_config(parser)
    add_playing(parser)
    parser.add_argument(
        "--policy",
        required=True,
        help="tutor, replay, yaw-blind, obstacle-blind, lookup, or a checkpoint's file",
    )
    parser.add_argument("--trials", type=positive, default=52, help="how many situations")
    parser.add_argument(
        "--seed", type=int, default=1000, help="the same seed gives the same situations"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--out", type=Path, help="folder in which the rollouts are recorded")
    parser.add_argument("--video", type=Path, help="MP4 file for a video of the first trial")


def run(arguments: argparse.Namespace) -> int:
    """Play the trials and print what succeeded."""
    config = playing_config(arguments)
    jobs = trial_jobs(config, arguments.trials, arguments.seed, arguments.out)
    tally, first = Tally(), None
    started = time.monotonic()
    played = play_all(config, arguments.policy, jobs, workers=arguments.workers)
    with progress_bar(f"evaluating {arguments.policy}", len(jobs)) as advance, closing(played):
        for job, episode in played:
            tally.add(episode.outcome)
            first = episode if job is jobs[0] else first
            advance()
    result = result_json(config, arguments.policy, tally, time.monotonic() - started)
    if arguments.json:
        print(json.dumps(result))
    else:
        title = "{policy} on {task} in {backend}, {trials} trials, {wall_s:.1f} s".format(**result)
        Console().print(success_table(title, tally))
    if arguments.video is not None and first is not None:
        write_video(first, arguments.video, config.simulator)
    return 0
