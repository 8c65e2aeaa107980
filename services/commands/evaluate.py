"""`vmdnn evaluate`: test a policy in situations that were not tutored."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from actors.tasks.registry import make_task
from proto.config import Config
from proto.errors import UserError
from proto.storage import written_whole
from proto.variables import parse_situation
from services.arguments.common import add_config, add_playing, playing_config, positive, seed
from services.playing.video import write_video
from services.playing.video_file import video_argument
from services.playing.workers import Job, play_all
from services.terminal.console import make_console
from services.terminal.progress import progress_bar
from services.terminal.tables import success_table
from services.trials.evaluation import result_json, situation_jobs, trial_jobs
from services.trials.success import Tally
from services.trials.trial_log import CountedTrial


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    add_config(parser)
    add_playing(parser)
    parser.add_argument(
        "--policy",
        required=True,
        help="tutor, a baseline of the task (`vmdnn inspect task` lists them), pretrained:NAME, a"
        " checkpoint's file, or a class of your own as package.module:Class; a task may name"
        " blinded policies, such as blank-screen:POLICY",
    )
    parser.add_argument("--trials", type=positive, default=52, help="number of situations")
    parser.add_argument(
        "--seed", type=seed, default=1000, help="the same seed gives the same situations"
    )
    parser.add_argument(
        "--situation",
        action="append",
        metavar="NAME=VALUE,...",
        help="play this situation instead of those of the seed; `vmdnn inspect task` lists the"
        " variables; may be repeated",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument(
        "--outcomes", type=Path, help="file to write, with one line of JSON for each trial"
    )
    parser.add_argument("--out", type=Path, help="folder in which the rollouts are recorded")
    parser.add_argument(
        "--states",
        action="store_true",
        help="record the activity of the network's subnets in the rollouts; a megabyte each",
    )
    parser.add_argument(
        "--video", type=video_argument, help="file for a video of the first trial, .mp4 or .gif"
    )


def run(arguments: argparse.Namespace) -> int:
    """Play the trials and print the success rates."""
    config = playing_config(arguments)
    jobs = _jobs(config, arguments)
    tally, first = Tally(), None
    trials: list[CountedTrial] = []
    started = time.monotonic()
    played = play_all(config, arguments.policy, jobs, workers=arguments.workers)
    with progress_bar(f"evaluating {arguments.policy}", len(jobs)) as advance, closing(played):
        for job, episode in played:
            tally.add(episode.outcome)
            trials.append(CountedTrial.of(episode, run_id=episode.policy))
            first = episode if job is jobs[0] else first
            advance()
    if arguments.outcomes is not None:
        _write_outcomes(arguments.outcomes, trials)
    result = result_json(config, arguments.policy, tally, time.monotonic() - started)
    if arguments.json:
        print(json.dumps(result))
    else:
        title = "{policy} on {task} in {backend}, {trials} trials, {wall_s:.1f} s".format(**result)
        make_console().print(success_table(title, tally))
    if arguments.video is not None and first is not None:
        write_video(first, arguments.video, config)
    return 0


def _jobs(config: Config, arguments: argparse.Namespace) -> list[Job]:
    if arguments.states and arguments.out is None:
        raise UserError("--states are recorded in the rollouts; add --out DIR to record rollouts")
    if arguments.situation is None:
        jobs = trial_jobs(config, arguments.trials, arguments.seed, arguments.out)
    else:
        task = make_task(config.task)
        situations = [
            parse_situation(text, task.variables, task.name) for text in arguments.situation
        ]
        jobs = situation_jobs(situations, arguments.seed, arguments.out)
    return [replace(job, states=arguments.states) for job in jobs]


def _write_outcomes(path: Path, trials: Iterable[CountedTrial]) -> None:
    with written_whole(path) as stream:
        stream.writelines(trial.line() for trial in sorted(trials, key=lambda trial: trial.seed))
